"""Bedrooms as they were arranged."""

from collections import Counter

import numpy as np
import pytest
from homes_on_disk import BEDS
from shapely.geometry import Point


def test_bedrooms_hold_one_bed_with_its_headboard_on_a_wall(rooms):
    kinds = Counter()
    for room in rooms["bedroom"]:
        beds = [piece for piece in room["pieces"] if piece["class"] in BEDS]
        assert len(beds) == 1, room["id"]
        kinds[beds[0]["class"]] += 1
        for corner in beds[0]["corners"][:2]:  # the two at -z: the head
            assert room["floor"].exterior.distance(Point(corner)) < 0.04
    # Five standard deviations of 400 draws are 0.11, 0.10, 0.08.
    assert kinds["double_bed"] / 400 == pytest.approx(0.70, abs=0.11)
    assert kinds["single_bed"] / 400 == pytest.approx(0.18, abs=0.10)
    assert kinds["kids_bed"] / 400 == pytest.approx(0.12, abs=0.08)


def test_nightstands_stand_beside_the_bed(rooms):
    for room in rooms["bedroom"]:
        bed = next(piece for piece in room["pieces"] if piece["class"] in BEDS)
        for piece in room["pieces"]:
            if piece["class"] == "nightstand":
                assert piece["footprint"].distance(bed["footprint"]) < 0.13
                assert np.cos(piece["yaw"] - bed["yaw"]) > 0.999
