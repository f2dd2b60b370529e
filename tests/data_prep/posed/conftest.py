"""A room and its views, which the tests of other tools' files compare with."""

import pytest
from capture_files import write_plain
from posed_files import PosedRoom, Thing, furniture, prepared


@pytest.fixture
def room(tmp_path):
    """The bed, a chair that stands before a part of it in some views, and the backpack."""
    things = furniture()
    things[1] = Thing(300, "Chair", (0.3, 0.4, 0.0), (0.7, 0.8, 0.9))
    room = PosedRoom(tmp_path / "rooms" / "attic", things)
    for eye in [(-2.5, 0.1, 1.5), (2.5, 0.3, 1.6), (0.1, 2.6, 1.4), (1.6, -2.4, 1.7), (-2, 2.3, 1)]:
        room.look(eye, (0.1, 0.1, 0.3))
    write_plain(room)
    return room


@pytest.fixture
def plain(room):
    """The views of the room as transforms.json and PNGs."""
    return prepared(room)
