"""Rooms drawn by the shipped priors, with and without a request, are those of the golden file.

A change of what is drawn replaces the file: `TAKE=1 pytest tests/lifted/drawing`
and says in its commit, with statistics, that new rooms are as good.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from golden_values import FOLDER, TAKE

import sceneprior
from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene, SceneObject

GOLDEN = FOLDER / "drawn_rooms.npz"
ROOMS = 20
"""Plain rooms of a prior, and requested rooms of all its requests together."""
MAY_DIFFER = 2
"""Rooms that may differ: another CPU may round a probability to the other side of a number."""
NEAR_M = 1e-3
L_SHAPE = [[0, 0], [5, 0], [5, 3], [2.5, 3], [2.5, 6], [0, 6]]
BEDROOMS: list[dict[str, Any]] = [
    {"want": "two nightstands"},
    {"want": "a 4 x 3 m bedroom with a door and two nightstands beside the double bed"},
    {"floor": "4x3.5", "openings": "door@south:1.5,window@north", "ceiling_m": 2.6},
    {"floor": L_SHAPE, "openings": "door", "want": {"desk": ">=1", "relations": [
        {"subject": "desk", "relation": "at a wall"}]}},
    {"want": {"double_bed": 1, "sofa": 0}, "objects": [
        SceneObject("desk", (1.0, 0.4, -1.5), (1.2, 0.8, 0.6))]},
]  # fmt: skip
LIVING_ROOMS: list[dict[str, Any]] = [
    {"want": "a table and four chairs"},
    {"floor": "5x4", "openings": "door,window"},
    {"floor": L_SHAPE, "openings": "door", "ceiling_m": 2.6, "want": "a sofa facing the tv stand"},
    {"want": {"relations": [
        {"subject": "sofa", "relation": "at a wall"},
        {"subject": "armchair", "relation": "beside", "target": "sofa"}]}},
    {"want": {"coffee_table": ">=1"}, "objects": [
        SceneObject("sofa", (0.0, 0.4, -1.5), (1.9, 0.8, 0.9))]},
]  # fmt: skip
PRIORS = {
    "bedroom": BEDROOMS,
    "demo-bedroom": BEDROOMS,
    "procthor-bedroom": BEDROOMS,
    "living": LIVING_ROOMS,
    "procthor-living": LIVING_ROOMS,
}


def drawn(name: str) -> dict[str, list[Scene]]:
    """Plain and requested rooms of a prior."""
    prior = sceneprior.load(name)
    each = ROOMS // len(PRIORS[name])
    return {
        "plain": prior.sample(ROOMS, seed=7),
        "requested": [
            room
            for number, asked in enumerate(PRIORS[name])
            for room in prior.sample(each, seed=7 + number, **asked)
        ],
    }


def as_rows(rooms: Sequence[Scene]) -> np.ndarray:
    """One row per object: room, class, centre, extents and yaw (9 if unknown), to 1e-4."""
    rows = [
        [row, label_set(room.label_set).index(item.label), *item.center_m, *item.size_m,
         9.0 if item.turned is None else item.turned.yaw_rad]
        for row, room in enumerate(rooms)
        for item in room.objects
    ]  # fmt: skip
    return np.array(rows, dtype=np.float64).reshape(-1, 9).round(4).astype(np.float32)


@pytest.mark.parametrize("name", PRIORS)
def test_drawn_rooms_are_the_golden_ones(name: str) -> None:
    found = {kind: as_rows(rooms) for kind, rooms in drawn(name).items()}
    known = dict(np.load(GOLDEN)) if GOLDEN.exists() else {}
    if TAKE:
        known |= {f"{name} {kind}": rows for kind, rows in found.items()}
        np.savez_compressed(GOLDEN, **known)
    for kind, rows in found.items():
        golden = known[f"{name} {kind}"]
        same = 0
        for row in range(ROOMS):
            ours, theirs = (part[part[:, 0] == row, 1:] for part in (rows, golden))
            same += ours.shape == theirs.shape and np.abs(ours - theirs).max(initial=0) < NEAR_M
        assert same >= ROOMS - MAY_DIFFER, f"{kind}: {same} of {ROOMS} rooms are the golden ones"
