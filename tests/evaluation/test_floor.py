"""Floors with known answers, and a raster of discs as the obvious twin."""

import numpy as np
import pytest

from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shell import floor_polygon
from sceneprior.evaluation.metrics.placement import (
    AGENT_RADIUS_M,
    between_furniture,
    outside_count,
    walkable_share,
)

FLOOR = np.array([[-2.0, -1], [2, -1], [2, 1], [-2, 1]])


def piece(x, z, width, depth) -> SceneObject:
    return SceneObject("desk", (float(x), 0.5, float(z)), (float(width), 1.0, float(depth)))


def room(*objects, floor=None) -> Scene:
    return Scene("a", "front3d_bedroom", objects, floor)


def on_floor(scene: Scene) -> float | None:
    return walkable_share(scene, floor_polygon(scene))


def test_pieces_out_of_bounds_are_counted_past_five_percent():
    inside = piece(0, 0, 1, 1)
    # 0.04 and 0.06 m of 1 m beyond the wall at x = 2.
    grazing, poking = piece(1.54, 0, 1, 1), piece(1.56, 0, 1, 1)
    away = piece(9, 9, 1, 1)
    assert outside_count(room(inside, grazing, poking, away, floor=FLOOR)) == (2, 4)
    assert outside_count(room(inside)) == (0, 0)
    assert outside_count(room(floor=FLOOR)) == (0, 0)


def test_a_wall_of_furniture_parts_the_floor_in_known_areas():
    # 4 x 2 m; a shelf across from x = 0 to 0.5. A disc of 0.2 m stands on 1.6 m x 1.6 m to the
    # left and 1.1 m x 1.6 m to the right: the shelf's corners lie in the walls.
    parted = room(piece(0.25, 0, 0.5, 2), floor=FLOOR)
    assert on_floor(parted) == pytest.approx(1.6 / 2.7, abs=1e-9)
    # 1 m of it is open: one piece.
    assert on_floor(room(piece(0.25, -0.5, 0.5, 1), floor=FLOOR)) == 1
    # 0.39 m are not enough for a disc of 0.4 m, 0.41 m are.
    for gap, joined in ((0.39, False), (0.41, True)):
        share = on_floor(room(piece(0.25, -gap / 2, 0.5, 2 - gap), floor=FLOOR))
        assert (share == 1) == joined


def test_without_a_floor_the_rectangle_around_furniture_takes_its_place():
    ends = piece(-1.9, 0, 0.2, 2), piece(1.9, 0, 0.2, 2)  # they span 4 x 2 m
    assert between_furniture(room(*ends)) == 1
    middle = piece(0.1, 0, 0.2, 2)  # leaves 1.8 - 0.4 and 1.6 - 0.4 m
    assert between_furniture(room(*ends, middle)) == pytest.approx(1.4 / 2.6, abs=1e-9)
    assert on_floor(room(*ends, middle)) is None
    assert between_furniture(room(ends[0])) is None and between_furniture(room()) is None
    assert on_floor(room(floor=FLOOR)) == 1


def test_a_raster_of_discs_agrees(rng):
    from scipy import ndimage

    step = 0.01
    x, z = np.meshgrid(np.arange(-2, 2, step) + step / 2, np.arange(-1, 1, step) + step / 2)
    seen_parted = 0
    for _ in range(12):
        pieces = [
            piece(*rng.uniform((-2, -1), (2, 1)), *rng.uniform(0.2, 1.2, size=2)) for _ in range(5)
        ]
        free = (2 - np.abs(x) >= AGENT_RADIUS_M) & (1 - np.abs(z) >= AGENT_RADIUS_M)
        for item in pieces:
            dx = np.maximum(np.abs(x - item.center_m[0]) - item.size_m[0] / 2, 0)
            dz = np.maximum(np.abs(z - item.center_m[2]) - item.size_m[2] / 2, 0)
            free &= np.hypot(dx, dz) >= AGENT_RADIUS_M
        labels, count = ndimage.label(free)
        areas = np.bincount(labels.ravel())[1:]
        by_hand = areas.max() / areas.sum() if count else 0.0
        seen_parted += by_hand < 0.95
        exact = on_floor(room(*pieces, floor=FLOOR))
        # Cells of 1 cm along about 10 m of edges, on 1 to 4 m2.
        assert exact == pytest.approx(by_hand, abs=0.03)
    assert seen_parted >= 2
