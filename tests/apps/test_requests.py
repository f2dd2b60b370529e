"""Requests: files, options of the commands, and given objects."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import sceneprior
from sceneprior.apps.sample import load_request, merged
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, Scene, SceneObject
from sceneprior.lifted.requests.request import RequestFile
from sceneprior.render.scene_files import save

BED = {"class": "double_bed", "center_m": [0.0, 0.3, -0.4], "size_m": [1.8, 0.6, 2.0]}
REQUEST = {
    "format": "sceneprior-request", "version": 1, "floor": "4x3", "openings": ["door@south"],
    "ceiling_m": 2.6, "objects": [BED],
    "want": {
        "nightstand": 1,
        "relations": [{"subject": "nightstand", "relation": "near", "target": "double_bed"}],
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def prior():
    return sceneprior.load("procthor-bedroom")


def written(folder: Path, **changes: Any) -> Path:
    path = folder / "request.json"
    path.write_text(json.dumps({**REQUEST, **changes}))
    return path


def test_a_file_asks_what_its_keys_say(prior, tmp_path):
    (room,) = prior.sample(1, seed=0, **load_request(written(tmp_path)))
    bed = room.objects[0]
    assert (bed.label, bed.center_m, bed.size_m) == (
        "double_bed", (0.0, 0.3, -0.4), (1.8, 0.6, 2.0),
    )  # fmt: skip
    assert bed.mesh is not None and room.extra["given"] == [0]
    assert all(each["holds"] for each in room.extra["wishes"]) and len(room.extra["wishes"]) == 5
    assert room.ceiling_m == 2.6 and room.openings[0].start_m[1] == pytest.approx(1.5)
    assert "want" in RequestFile.model_json_schema()["properties"]


def test_a_part_is_in_the_file_or_in_the_options():
    assert merged({"floor": "4x3", "want": None}, {"want": "a bed"}) == {
        "floor": "4x3", "want": "a bed",
    }  # fmt: skip
    with pytest.raises(InputError, match="the request's file and the options have floor"):
        merged({"floor": "4x3"}, {"floor": "5x3"})


def test_a_floor_of_a_file_brings_its_door(prior, tmp_path):
    outline = np.array([[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]])
    door = Opening("door", (-0.5, -1.5), (0.4, -1.5), 0.0, 2.0)
    save(Scene("plan", "front3d_bedroom", (), outline, openings=(door,)), tmp_path / "plan.json")
    (room,) = prior.sample(1, floor=f"{tmp_path}/plan.json")
    assert room.openings == (door,) and (room.floor_m == outline).all()
    (room,) = prior.sample(1, floor=f"{tmp_path}/plan.json", openings="window@north")
    assert [each.kind for each in room.openings] == ["window"]
    # ... and in a file of its own, to which the options may add.
    asked = {"floor": f"{tmp_path}/plan.json:plan"}
    read = load_request(written(tmp_path, **asked, openings=[], objects=[], want=None))
    assert read == {**asked, "ceiling_m": 2.6}
    (room,) = prior.sample(1, **read)
    assert room.openings == (door,) and room.ceiling_m == 2.6


def test_an_empty_room_is_completed_where_it_stands(prior):
    corners = [[0.0, 0], [4, 0], [4, 3], [0, 3]]
    scene = Scene("mine", "front3d_bedroom", (), np.array(corners))
    for asked in ({}, {"classes": ["double_bed"]}):
        (room,) = prior.complete(scene, 1, **asked)
        assert room.floor_m.tolist() == corners
        assert ((room.centers_m > 0) & (room.centers_m < [4, 3, 3])).all() and room.objects


def test_a_floor_in_its_place_replaces_that_of_the_scene(prior):
    bed = SceneObject("double_bed", (0.0, 0.3, -0.4), (1.8, 0.6, 2.0))
    door = Opening("door", (-0.5, 3.0), (0.4, 3.0), 0.0, 2.0)
    outline = np.array([[-3, -3], [3, -3], [3, 3], [-3, 3]], dtype=float)
    scene = Scene("mine", "front3d_bedroom", (bed,), outline, openings=(door,), ceiling_m=3.0)
    (room,) = prior.complete(scene, 1, floor="4x3", openings="window@north", want="a nightstand")
    assert np.ptp(room.floor_m, axis=0).tolist() == [4, 3] and room.ceiling_m is None
    assert [each.kind for each in room.openings] == ["window"]
    assert all(each["holds"] for each in room.extra["wishes"])
    (room,) = prior.complete(scene, 1, ceiling_m=2.5)
    assert (room.floor_m == outline).all() and room.openings == (door,) and room.ceiling_m == 2.5


def test_complete_takes_requests(command, tmp_path):
    bed = SceneObject("double_bed", (0.0, 0.3, -0.4), (1.8, 0.6, 2.0))
    save(Scene("mine", "front3d_bedroom", (bed,)), tmp_path / "given.json")
    lamp = {"class": "nightstand", "center_m": [1.3, 0.25, -1.2], "size_m": [0.4, 0.5, 0.4]}
    path = written(tmp_path, floor=None, openings=[], want=None, objects=[lamp])
    status, told, errors = command(
        "complete", "--run", "procthor-bedroom", "--given", tmp_path / "given.json", "-n", 1,
        "--floor", "-2,-1.5 2,-1.5 2,1.5 -2,1.5", "--openings", "door@south", "--request", path,
        "--want", "nightstand: 2", "--shell", "walls", "--out", tmp_path / "rooms",
    )  # fmt: skip
    assert status == 0 and "around 2 given objects" in told, errors
    room = sceneprior.load_scene(tmp_path / "rooms" / "complete_00.json")
    labels = [item.label for item in room.objects]
    assert labels[:2] == ["double_bed", "nightstand"] and labels.count("nightstand") == 2
    assert room.ceiling_m == 2.6 and [each.kind for each in room.openings] == ["door"]
    assert b"wall_0" in (tmp_path / "rooms" / "complete_00.glb").read_bytes()


def test_the_file_of_the_guide_is_a_request(prior, tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "requests.md").read_text()
    (block,) = re.findall(r"```json\n(.*?)```", page, flags=re.S)
    (tmp_path / "request.json").write_text(block)
    (room,) = prior.sample(1, seed=0, **load_request(tmp_path / "request.json"))
    assert [each["holds"] for each in room.extra["wishes"]] == [True] * 7
    assert [each.kind for each in room.openings] == ["window", "door"]
