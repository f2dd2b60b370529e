"""Two data sets of 400 rooms, made once for all tests of this folder."""

import pytest
from homes_on_disk import TYPES, read_rooms

from data_prep.homes.make import make_homes


@pytest.fixture(scope="session")
def homes(tmp_path_factory):
    """Room type -> folder of 400 rooms, the size the demo makes."""
    folder = tmp_path_factory.mktemp("homes")
    for room_type in TYPES:
        make_homes(folder / room_type, 400, room_type, seed=0)
    return {room_type: folder / room_type for room_type in TYPES}


@pytest.fixture(scope="session")
def rooms(homes):
    """Room type -> every room as read back from disk."""
    return {room_type: read_rooms(folder, room_type) for room_type, folder in homes.items()}
