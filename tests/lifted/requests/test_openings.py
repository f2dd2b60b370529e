"""Doors and windows: what is read, where they are placed, and what stays free before them."""

import numpy as np
import pytest
import shapely

import sceneprior
from sceneprior.core.scene import Opening
from sceneprior.lifted.requests.floors import Floor, RoomShape, read_floor
from sceneprior.lifted.requests.openings import WantedOpening, place_openings, read_openings
from sceneprior.lifted.requests.rules import zones_of

DOOR = Opening("door", (-0.5, -1.5), (0.4, -1.5), 0.0, 2.0)
FLOOR = read_floor("4x3")


def placed(text: str, seed: int = 0) -> tuple[Opening, ...]:
    return place_openings(Floor(FLOOR), read_openings(text), np.random.default_rng(seed))


def test_texts_and_mappings_are_read():
    assert read_openings("door, window@north,door@2:1.5") == (
        WantedOpening("door"), WantedOpening("window", "north"), WantedOpening("door", 2, 1.5),
    )  # fmt: skip
    entry = {"kind": "door", "start_m": [-0.5, -1.5], "end_m": [0.4, -1.5]}
    assert read_openings([entry, DOOR]) == (DOOR, DOOR)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("door@north:1", [(-1.45, -1.5), (-0.55, -1.5)]),
        ("door@south:1", [(-1.45, 1.5), (-0.55, 1.5)]),
        ("door@west:1", [(-2, -0.95), (-2, -0.05)]),
        ("door@east:1", [(2, -0.95), (2, -0.05)]),
    ],
)
def test_places_count_from_the_western_or_northern_end(text, line):
    (door,) = placed(text)
    np.testing.assert_allclose(sorted([door.start_m, door.end_m]), line)


def test_floors_are_drawn_on_which_doors_and_windows_fit():
    wanted = "window@north," * 4 + "door@south:3"
    for room in sceneprior.load("procthor-bedroom").sample(8, 0, openings=wanted):
        assert len(room.openings) == 5 and all(each["holds"] for each in room.extra["wishes"])


def test_drawn_places_lie_in_walls_apart_from_each_other():
    walls = set()
    for seed in range(30):
        found = placed("door,window,window", seed)
        lines = [shapely.LineString([each.start_m, each.end_m]) for each in found]
        outline = shapely.Polygon(FLOOR).exterior.buffer(1e-6)
        assert all(outline.covers(line) for line in lines)
        assert min(a.distance(b) for a in lines for b in lines if a is not b) >= 0.1 - 1e-9
        walls.add(tuple(np.round(lines[0].centroid.coords[0], 0)))
    assert len(walls) > 4


def test_zones_reach_into_the_room():
    window = Opening("window", (-2.0, -1.0), (-2.0, 0.2), 0.9, 2.1)
    zones = zones_of(RoomShape(Floor(FLOOR), (DOOR, window)))
    (swing,), (before,) = zones["door"], zones["window"]
    np.testing.assert_allclose(swing.polygon.bounds, [-0.49, -1.49, 0.39, -0.61], atol=1e-9)
    np.testing.assert_allclose(before.polygon.bounds, [-1.99, -0.99, -1.61, 0.19], atol=1e-9)
    assert (swing.from_m, swing.to_m, before.from_m, before.to_m) == (0, 2, 0.9, 2.1)
