"""The floor is where the lowest tracked pieces end, and unknown where views do not tell."""

import numpy as np
import pytest
from posed_files import PosedRoom, Thing, prepared

SET = "void,bed,chair,lamp,book"


def eyes(made):
    return np.linalg.inv(made.views.world_to_camera.astype(float))[:, :3, 3]


@pytest.fixture
def room(tmp_path):
    made = PosedRoom(tmp_path / "room", size=(240, 320), focal_px=200.0)
    made.look((1.0, 2.4, 1.6), (0.1, 0.1, 0.3))
    made.look((-2.4, 0.3, 1.8), (0.1, 0.1, 0.3))
    return made


@pytest.mark.parametrize("lift", [0.0, -3.0])
def test_pieces_on_the_floor_find_it_whatever_hangs_or_lies_on_them(room, lift):
    room.things += [
        Thing(20, "lamp", (0.2, -0.2, 1.7), (0.5, 0.1, 2.0)),
        Thing(21, "book", (-0.4, -0.4, 0.5), (-0.1, -0.1, 0.6)),
        Thing(22, "chair", (-1.3, 0.3, 0.0), (-0.9, 0.7, 0.8)),
    ]
    for thing in room.things:
        thing.low = (*thing.low[:2], thing.low[2] + lift)
        thing.high = (*thing.high[:2], thing.high[2] + lift)
    for pose in room.poses:
        pose[2, 3] += lift
    room.write()
    made = prepared(room, SET, camera_height_m=9.0)
    assert abs(eyes(made)[:, 1].min() - 1.5) < 0.03
    (said,) = (note for note in made.notes if "the floor" in note)
    assert said.startswith("the floor is found where ") and said.endswith("below the lowest camera")


def test_a_camera_that_only_turns_does_not_tell(room):
    room.poses = []
    for step in (-0.2, 0.0, 0.2, 0.4):
        room.look((2.0, -2.0, 1.5), (0.1 + step, 0.1, 0.3))
    room.write()
    assert "assumed" in prepared(room, SET).notes[-1]
