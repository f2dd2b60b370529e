"""Plans: outlines, walls, and that pieces stand clear of each other inside the room."""

from itertools import combinations

import pytest
from homes_on_disk import TYPES

CEILING_CLASSES = {"pendant_lamp", "ceiling_lamp"}


@pytest.mark.parametrize("room_type", TYPES)
def test_no_boxes_intersect_and_all_stand_inside(rooms, room_type):
    for room in rooms[room_type]:
        for a, b in combinations(room["pieces"], 2):
            if min(a["levels"][1], b["levels"][1]) - max(a["levels"][0], b["levels"][0]) > 1e-4:
                assert a["footprint"].intersection(b["footprint"]).area == 0, room["id"]
        inside = room["floor"].buffer(1e-4)  # coordinates are rounded to 1e-5
        for piece in room["pieces"]:
            assert inside.contains(piece["footprint"]), (room["id"], piece["class"])
            assert piece["levels"][1] <= room["height"] + 1e-3
            if piece["class"] in CEILING_CLASSES:
                assert piece["levels"][1] == pytest.approx(room["height"], abs=1e-3)
                assert piece["levels"][0] > 1.0
            else:
                assert piece["levels"][0] == pytest.approx(0, abs=1e-4)
