"""Two data sets of 400 rooms, made and read once for all tests of this folder."""

import pickle

import pytest
from homes_on_disk import TYPES, read_rooms

from data_prep.homes.make import make_homes


@pytest.fixture(scope="session")
def homes(made_once):
    """Room type -> folder of 400 rooms, the size the demo makes."""

    def make(folder):
        for room_type in TYPES:
            make_homes(folder / room_type, 400, room_type, seed=0)

    folder = made_once("homes", make)
    return {room_type: folder / room_type for room_type in TYPES}


@pytest.fixture(scope="session")
def rooms(homes, made_once):
    """Room type -> every room as read back from disk."""

    def read(path):
        rooms = {room_type: read_rooms(folder, room_type) for room_type, folder in homes.items()}
        path.write_bytes(pickle.dumps(rooms))

    return pickle.loads(made_once("homes.pickle", read).read_bytes())
