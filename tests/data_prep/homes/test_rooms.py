"""Rooms in which one can live."""

import pytest
from homes_on_disk import TYPES

from data_prep.homes.rooms import FREE_SHARE


@pytest.mark.parametrize("room_type", TYPES)
def test_rooms_have_room_to_walk_and_pass_atiss_filters(rooms, room_type):
    side, most = {"bedroom": (6, 13), "living": (12, 21)}[room_type]
    for room in rooms[room_type]:
        x0, z0, x1, z1 = room["floor"].bounds
        assert max(x1 - x0, z1 - z0) <= side
        assert 2.6 <= room["height"] <= 3.0
        assert 2 <= len(room["pieces"]) <= most
        assert room["floor"].area == pytest.approx(room["size"], abs=0.01)
        standing = [p["footprint"].area for p in room["pieces"] if p["levels"][0] < 0.5]
        assert sum(standing) <= (1 - FREE_SHARE) * room["floor"].area + 1e-3
