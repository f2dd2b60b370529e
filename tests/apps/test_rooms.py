"""Folders of rooms: what is written over, and what is not."""

from dataclasses import replace

import pytest
from PIL import Image

from sceneprior.apps.rooms import overview, write_scene, write_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.render.appearance import CAPTION_PX


@pytest.fixture
def scene() -> Scene:
    bed = SceneObject("double_bed", (0.0, 0.75, 0.0), (2.0, 1.5, 2.0))
    return Scene("room", "front3d_bedroom", (bed,), extra={"seed": 3})


def test_new_scenes_leave_none_of_the_old_ones_behind_and_everything_else_alone(scene, tmp_path):
    rooms = [replace(scene, name=name) for name in "abc"]
    write_scenes(rooms, tmp_path)
    (tmp_path / "latents.npz").write_bytes(b"of the old rooms")
    (tmp_path / "scores.json").write_text('{"format": "sceneprior-scores"}')
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "c.glb.0123abcd.part").write_bytes(b"of a process that was killed")
    (tmp_path / "film.part").write_bytes(b"mine, too")
    write_scenes(rooms[1:2], tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "b.json", "b.glb", "b.png", "overview.png", "scores.json", "notes.txt", "film.part",
    }  # fmt: skip


def test_an_overview_says_how_many_rooms_it_lacks(scene, monkeypatch):
    monkeypatch.setattr("sceneprior.apps.rooms.OVERVIEW_ROOMS", 4)
    four, five = overview([scene] * 4), overview([scene] * 5)
    assert five.shape == (four.shape[0] + CAPTION_PX, *four.shape[1:])
    assert five[:CAPTION_PX].min() == 0 and (five[CAPTION_PX:] == four).all()


def test_a_failed_write_leaves_nothing_under_the_final_name(scene, tmp_path, monkeypatch):
    def torn(picture, file, **_):
        file.write(b"half of a PNG")
        raise OSError("No space left on device")

    monkeypatch.setattr(Image.Image, "save", torn)
    with pytest.raises(OSError, match="No space left"):
        write_scene(scene, tmp_path, "room")
    # The GLB was whole; without the JSON, which comes last, nobody takes it for a scene.
    assert [path.name for path in tmp_path.iterdir()] == ["room.glb"]
