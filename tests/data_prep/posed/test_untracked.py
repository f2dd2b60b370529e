"""Folders whose ids are those of single frames: `prep-posed --tracks auto`."""

import json

import numpy as np
import pytest
from PIL import Image
from posed_files import SET, PosedRoom, prepared

from data_prep.readers.posed.source import PosedSource
from data_prep.readers.posed.views import PosedSettings
from sceneprior.core.errors import InputError


@pytest.fixture
def room(tmp_path):
    """The bed, the chair and the backpack, from ten places."""
    room = PosedRoom(tmp_path / "room")
    for eye in [(-2.5, 0.1, 1.5), (2.5, 0.3, 1.6), (0.1, 2.6, 1.4), (1.6, -2.4, 1.7), (-2, 2.3, 1)]:
        room.look(eye, (0.1, 0.1, 0.3))
    return room.write(floor_m=0.0, floor_center_m=[0.1, -0.2])


def shuffle(room, unique):
    """Give each frame ids of its own, and write their classes as `unique` ids of the room, or in a
    JSON beside each PNG."""
    rng = np.random.default_rng(0)
    names = {thing.id: thing.name for thing in room.things}
    table, first = {}, 1
    for view in range(len(room.poses)):
        old = room.ids(view)
        new = np.zeros_like(old)
        own = {}
        for k in rng.permutation(np.unique(old[old > 0])).tolist():
            new[old == k] = first
            own[str(first)] = names[k]
            first += 1
        Image.fromarray(new).save(room.png(view))
        table |= own
        if not unique:
            first = 1
            room.png(view).with_suffix(".json").write_text(json.dumps(own))
    (room.folder / "classes.json").unlink()
    if unique:
        (room.folder / "classes.json").write_text(json.dumps(table))


def same_objects(made, plain):
    """Map from the objects found to those of given ids, checked to be one to one."""
    pairs = set(zip(made.instance_ids.ravel(), plain.instance_ids.ravel(), strict=True))
    assert len(pairs) == len(np.unique(plain.instance_ids))
    for a, b in pairs:
        if 0 < b <= len(plain.object_class):
            assert made.object_class[a - 1] == plain.object_class[b - 1]


@pytest.mark.parametrize("unique", [True, False])
def test_ids_of_single_frames_are_joined(room, unique):
    plain = prepared(room).views
    shuffle(room, unique)
    made = prepared(room, tracks="auto")
    same_objects(made.views, plain)
    assert any("3 objects are found from" in note for note in made.notes)


def test_classes_beside_each_png_need_no_option(room):
    plain = prepared(room).views
    shuffle(room, unique=False)
    made = prepared(room)
    same_objects(made.views, plain)
    assert any("3 objects are found from" in note for note in made.notes)
    (said,) = (text for text in PosedSource(room.folder, SET).assumptions() if "--tracks" in text)
    assert said.startswith("In 1 of 1 rooms ids belong to single images (PNGs of ids")


def test_right_ids_stay_as_they_are(room):
    plain, made = prepared(room).views, prepared(room, tracks="auto").views
    same_objects(made, plain)
    # A broken track: the bed has another id from the fifth frame on.
    names = json.loads((room.folder / "classes.json").read_text())
    (room.folder / "classes.json").write_text(json.dumps(names | {"4": "bed"}))
    for view in range(5, 10):
        ids = room.ids(view)
        ids[ids == 3] = 4
        Image.fromarray(ids).save(room.png(view))
    assert len(prepared(room).views.object_class) == 3
    same_objects(prepared(room, tracks="auto").views, plain)


def test_ids_of_single_frames_are_refused_as_tracks(room, cli):
    shuffle(room, unique=True)
    with pytest.raises(InputError, match=r"30 of its 30 ids are in one of 10 frames only, .*auto"):
        prepared(room)
    out = room.folder.parent / "shards"
    words = ("prep-posed", room.folder, "--label-set", SET, "--test-share", 0, "--out", out)
    result = cli(*words, "--tracks", "auto", "--workers", 1)
    assert result.exit_code == 0, result.output


def test_what_untracked_masks_lack(room):
    shuffle(room, unique=False)
    room.png(3).with_suffix(".json").unlink()
    with pytest.raises(InputError, match=r"put the classes of .* into frame_00003\.json"):
        prepared(room, tracks="auto")
    room.png(3).with_suffix(".json").write_text(json.dumps({"1": "bed"}))
    notes = prepared(room, tracks="auto").notes
    assert any("masks have no class in their frame's table: void" in note for note in notes)
    with pytest.raises(InputError, match=r"tracks is 'magic'; choose from given, auto"):
        PosedSettings(tracks="magic")
