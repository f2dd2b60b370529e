"""Faults that a person notices at first sight, each in a room without it and with it."""

import numpy as np
import pytest
import shapely

from sceneprior.core.arrangements import Piece
from sceneprior.lifted.requests.faults import faults_of

FLOOR = shapely.box(-3, -2.5, 3, 2.5)


def piece(label: str, x: float, z: float, size_m: tuple, front: tuple) -> Piece:
    return Piece(label, np.array([x, z], float), size_m, np.array(front, float), True)


def dining(x: float) -> list[Piece]:
    """A table with a chair at either long side, in the middle along z."""
    chairs = [piece("chair", x + side * 0.65, 0, (0.5, 0.9, 0.5), (-side, 0)) for side in (-1, 1)]
    return [piece("table", x, 0, (1.6, 0.75, 0.8), (1, 0)), *chairs]


LOUNGE = [
    piece("sofa", 0, 2.0, (2.0, 0.8, 0.9), (0, -1)),
    piece("tv_stand", 0, -2.25, (1.6, 0.5, 0.4), (0, 1)),
]
LOW = piece("coffee_table", 0, 1.0, (1.0, 0.4, 0.3), (0, 1))


@pytest.mark.parametrize(("pieces", "faults"), [
    ([*dining(0)], set()),
    ([*dining(2.0)], {("room to pull it out", (2,))}),
    ([*dining(0)[:2], piece("chair", 0.65, 0, (0.5, 0.9, 0.6), (-1, 0))],
     {("like the other chairs", (1, 2))}),
    ([*LOUNGE, LOW], set()),
    ([*LOUNGE, piece("coffee_table", 0, 1.25, (1.8, 0.4, 0.4), (0, 1))],
     {("room for legs", (0,))}),
    ([*LOUNGE, piece("coffee_table", 0, 0.5, (1.0, 0.7, 0.4), (0, 1))], set()),
    ([piece("double_bed", 0, 1.4, (1.6, 0.5, 2.0), (0, -1)),
      piece("television", 0, -2.2, (1.0, 0.6, 0.1), (0, 1)),
      piece("shelf", 0, -2.25, (1.2, 0.8, 0.5), (0, 1))], set()),
    ([*LOUNGE, *dining(0)], {("a view of the screen", (1,))}),
    ([*LOUNGE, *dining(2.0)[:2]], set()),
])  # fmt: skip
def test_rooms_have_the_faults_that_one_sees(pieces, faults):
    assert faults_of(pieces, FLOOR) == faults
