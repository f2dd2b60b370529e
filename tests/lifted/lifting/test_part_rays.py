"""Rays against parts and outlines: every compiled count has a slow twin."""

import numpy as np
import pytest
import shapely
from parts_of_rooms import TABLE, rays_of

from sceneprior.core.parts import ACROSS_X, ACROSS_Z, BOX, SQUARE, Parts, inside
from sceneprior.lifted.lifting.part_loss import (
    RayFit,
    area_table,
    stability,
)
from sceneprior.lifted.lifting.part_rays import (
    LEVELS,
    count_wrong,
    cut_rays,
    descend,
    meets,
    planes_of,
    volume_of,
)

MARGIN = 1.1
EVERYWHERE = area_table(SQUARE, LEVELS)


@pytest.mark.parametrize("kind", range(5))
@pytest.mark.parametrize("mirrored", range(4))
def test_a_ray_meets_a_part_where_points_along_it_are_inside(kind, mirrored):
    rng = np.random.default_rng(kind)
    starts, stops = rng.uniform(-10, LEVELS + 10, (2, 300, 3))
    ends = np.array([[4, 30], [20, 60], [10, 50]])
    met = np.empty(300, bool)
    meets(starts, stops - starts, kind, mirrored, ends, met)
    along = np.linspace(0, 1, 2000)[:, None, None]
    points = (starts + along * (stops - starts)) / LEVELS - 0.5
    parts = Parts(np.array([kind]), np.array([mirrored]), ends[None] / LEVELS - 0.5)
    slow = np.zeros(300, bool)
    for solid in parts.solids():
        slow |= inside(*solid, points).any(axis=0)
    assert (met >= slow).all() and (met & ~slow).sum() <= 3, "but for what steps leave out"
    assert 0.1 < met.mean() < 0.9


@pytest.mark.parametrize("mirrored", range(4))
def test_a_face_goes_where_the_fewest_rays_are_wrong(mirrored):
    """The first face that `descend` moves, compared with trying each of its levels."""
    fit = RayFit(rays_of(TABLE, 400, seed=mirrored), MARGIN, SQUARE, False)
    prices = fit.hit_price, fit.miss_price, 0.003, 0.002
    rng = np.random.default_rng(mirrored)
    for _ in range(4):
        low = rng.integers(1, 30, 3)
        start = np.stack([low, low + rng.integers(5, 30, 3)], axis=1)
        ends = np.array([[[0, 64], [56, 64], [0, 64]], start])
        trials = {}
        for place in range(start[0, 1]):
            moved = ends.copy()
            moved[1, 0, 0] = place
            trial = fit.guess(np.zeros(2, int), np.array([0, mirrored]), moved)
            wrong = (trial.met_by > 0) != fit.hits
            cost = prices[0] * (wrong & fit.hits).sum() + prices[1] * (wrong & ~fit.hits).sum()
            cost += prices[2] * volume_of(BOX, mirrored, moved[1])
            cost += prices[3] * (not planes_of(moved, 1)[0, place])
            trials[place] = cost
        swept = fit.guess(np.zeros(2, int), np.array([0, mirrored]), ends)
        descend(
            fit.starts, fit.spans, fit.inverse, fit.hits, swept.kinds, swept.mirrored,
            swept.ends, swept.covered, swept.met_by, np.array([1]), 1, *prices,
        )  # fmt: skip
        assert trials[int(swept.ends[1, 0, 0])] == pytest.approx(min(trials.values()))


TOP, LEG = [[0, 64], [41, 60], [0, 64]], [[0, 8], [0, 40], [0, 8]]
HIGH = [[0, 64], [42, 60], [0, 64]]
POST = [[28, 36], [0, 40], [28, 36]]
BOTH = ACROSS_X | ACROSS_Z
TRIANGLE = area_table(np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5]]), LEVELS)
"""Without the corner at high x and z."""
OUTSIDE = [[56, 64], [0, 40], [56, 64]]


@pytest.mark.parametrize(
    ("parts", "mirrored", "area", "hangs", "found"),
    [
        ([LEG, TOP], [BOTH, 0], EVERYWHERE, False, (0, 1, 0)),  # within a level
        ([LEG, TOP], [BOTH, 0], EVERYWHERE, True, (4, 1, 0)),
        ([LEG, HIGH], [BOTH, 0], EVERYWHERE, False, (42, 5, 0)),  # of the largest piece
        ([LEG, HIGH], [BOTH, 0], EVERYWHERE, True, (4, 5, 0)),
        ([HIGH], [0], EVERYWHERE, False, (42, 1, 0)),
        ([LEG, TOP], [0, 0], EVERYWHERE, False, (0, 1, 2 * (32 - 8))),  # on one leg
        ([LEG, TOP], [ACROSS_Z, 0], EVERYWHERE, False, (0, 1, 32 - 8)),
        ([POST, TOP], [0, 0], EVERYWHERE, False, (0, 1, 0)),  # a pedestal
        ([LEG, TOP], [BOTH, 0], TRIANGLE, False, (0, 1, 0)),
        # What lies outside the outline closes no gap.
        ([OUTSIDE], [0], TRIANGLE, False, (64, 0, 0)),
        ([OUTSIDE, TOP], [0, 0], TRIANGLE, False, (41, 1, 0)),
    ],
)
def test_parts_that_float_fall_apart_or_tip_over(parts, mirrored, area, hangs, found):
    assert stability(np.array(mirrored), np.array(parts), area, hangs) == found


def test_wrong_rays_of_several_objects_are_counted_at_once():
    rays = rays_of(TABLE, 300)
    rays.spans[:5] = 0  # these tell nothing
    whole = np.array([[[-0.5, 0.5]] * 3])
    solids = [*TABLE.solids(), (BOX, whole[0])]
    kinds = np.array([kind for kind, _ in solids])
    lows, highs = (np.stack([ends[:, side] for _, ends in solids]) * 2 / MARGIN for side in (0, 1))
    wrong = np.empty(3, np.int64)
    solids += [(BOX, whole[0])]
    kinds, lows, highs = (np.concatenate([part, part[-1:]]) for part in (kinds, lows, highs))
    first = np.array([0, len(solids) - 2, len(solids) - 1, len(solids)])
    half = SQUARE.clip(max=[0, 1])  # the half of the box in which x is negative
    corners = np.concatenate([SQUARE, SQUARE, half]) * 2 / MARGIN
    count_wrong(
        rays.starts, rays.spans, rays.hits, kinds, lows, highs, first, corners,
        np.array([0, 4, 8, 12]), np.full(3, np.inf), wrong,
    )  # fmt: skip
    assert wrong[0] == 0
    stopped = np.empty(3, np.int64)
    count_wrong(
        rays.starts, rays.spans, rays.hits, kinds, lows, highs, first, corners,
        np.array([0, 4, 8, 12]), np.array([0.0, 20.0, -3.0]), stopped,
    )  # fmt: skip
    assert stopped.tolist() == [0, 21, 0]
    starts, spans = (part * MARGIN / 2 for part in (rays.starts, rays.spans))
    known = np.abs(spans).sum(axis=1) > 0
    for item, ends in ((1, whole[0]), (2, whole[0].clip(max=[[0], [1], [1]]))):
        met = np.empty(len(spans), bool)
        levels = np.rint((ends + 0.5) * LEVELS).astype(np.int64)
        meets(starts * LEVELS + LEVELS / 2, spans * LEVELS, BOX, 0, levels, met)
        assert wrong[item] == ((met != rays.hits) & known).sum() > 30


L_SHAPE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.0], [0.0, 0.0], [0.0, 0.5], [-0.5, 0.5]])


def test_rays_are_cut_to_where_they_are_within_the_outline():
    """Against points along each ray."""
    rng = np.random.default_rng(1)
    starts, stops = rng.uniform(-0.9, 0.9, (2, 400, 3))
    starts[:20], stops[:20] = starts[:20] * 0.3, starts[:20] * 0.3 + [0, 0.4, 0]  # upright
    spans = stops - starts
    cut_starts, cut_spans = starts.copy(), spans.copy()
    cut_rays(cut_starts, cut_spans, L_SHAPE)
    along = np.linspace(0, 1, 4001)
    polygon = shapely.Polygon(L_SHAPE)
    met = 0
    for start, span, cut_start, cut_span in zip(starts, spans, cut_starts, cut_spans, strict=True):
        points = start + along[:, None] * span
        inside = np.flatnonzero(shapely.contains_xy(polygon, points[:, ::2]))
        if not len(inside):
            assert np.linalg.norm(cut_span) < 2e-3
            continue
        met += 1
        np.testing.assert_allclose(cut_start, points[inside[0]], atol=1e-3)
        np.testing.assert_allclose(cut_start + cut_span, points[inside[-1]], atol=1e-3)
    assert 100 < met < 390
