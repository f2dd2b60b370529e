"""Rays against parts and outlines: every compiled count has a slow twin."""

import numpy as np
import pytest
import shapely
from parts_of_rooms import TABLE, rays_of

from sceneprior.core.parts import ACROSS_X, ACROSS_Z, BOX, SQUARE, Parts, inside
from sceneprior.lifted.lifting.part_loss import RayFit
from sceneprior.lifted.lifting.part_rays import count_wrong, descend, meets
from sceneprior.lifted.lifting.part_regularizers import (
    LEVELS,
    area_table,
    cut_rays,
    gap_and_pieces,
    outline_of,
    overhang,
    planes_of,
    points_within,
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
    """A face of a box is moved; the levels are compared with trying each one."""
    fit = RayFit(rays_of(TABLE, 400, seed=mirrored), MARGIN)
    prices = fit.hit_price, fit.miss_price, 0.003, 0.002
    rng = np.random.default_rng(mirrored)
    for face in range(6):
        low = rng.integers(0, 30, 3)
        start = np.stack([low, low + rng.integers(5, 30, 3)], axis=1)
        others = np.array([[[0, 64], [56, 64], [0, 64]]])
        ends = np.concatenate([others, start[None]])
        guess = fit.guess(np.zeros(2, int), np.array([0, mirrored]), ends)
        axis, side = divmod(face, 2)
        # The other faces are held by trying one face at a time, in the order of descend.
        trials = {}
        reach = range(start[axis, 0] + 1, LEVELS + 1) if side else range(start[axis, 1])
        for place in reach:
            moved = ends.copy()
            moved[1, axis, side] = place
            trial = fit.guess(np.zeros(2, int), np.array([0, mirrored]), moved)
            wrong = (trial.met_by > 0) != fit.hits
            cost = prices[0] * (wrong & fit.hits).sum() + prices[1] * (wrong & ~fit.hits).sum()
            cost += prices[2] * volume_of(BOX, mirrored, moved[1])
            cost += prices[3] * (not planes_of(moved, 1)[axis, place])
            trials[place] = cost
        if face == 0:  # the first face that descend moves
            one_sweep = fit.guess(np.zeros(2, int), np.array([0, mirrored]), ends)
            before = min(trials.values())
            descend(
                fit.starts, fit.spans, fit.inverse, fit.hits, one_sweep.kinds, one_sweep.mirrored,
                one_sweep.ends, one_sweep.covered, one_sweep.met_by, np.array([1]), 1, *prices,
            )  # fmt: skip
            assert fit.loss(one_sweep) <= fit.loss(guess) + 1
            assert trials[int(one_sweep.ends[1, 0, 0])] == pytest.approx(before)


def test_gaps_are_those_to_the_floor_or_the_ceiling():
    legs = np.array([[[0, 8], [0, 40], [0, 8]]])
    top = np.array([[[0, 64], [41, 60], [0, 64]]])
    both = np.concatenate([legs, top])
    assert gap_and_pieces(np.array([3, 0]), both, EVERYWHERE, False) == (0, 1), "within a level"
    assert gap_and_pieces(np.array([3, 0]), both, EVERYWHERE, True) == (4, 1)
    top[0, 1, 0] = 42
    apart = np.concatenate([legs, top])
    for hangs, gap in ((False, 42), (True, 4)):
        found = gap_and_pieces(np.array([3, 0]), apart, EVERYWHERE, hangs)
        assert found == (gap, 5), "the gap is that of the largest piece"
    assert gap_and_pieces(np.zeros(1, int), top, EVERYWHERE, False) == (42, 1)


def test_what_lies_outside_the_outline_supports_nothing():
    """A triangle without the corner at high x and z, in which one of four legs stands."""
    legs = np.array([[[0, 8], [0, 40], [0, 8]], [[0, 64], [40, 64], [0, 64]]])
    area = area_table(np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5]]), 64)
    assert area[-1, -1] == pytest.approx(64 * 64 / 2, rel=0.02)
    assert area[8, 8] == 64 and area[20, 4] == 80
    assert gap_and_pieces(np.array([3, 0]), legs, area, False) == (0, 1)
    far = legs[:1] + np.array([[56], [0], [56]])
    assert gap_and_pieces(np.zeros(1, int), far, area, False) == (64, 0)
    both = np.concatenate([far, legs[1:]])
    assert gap_and_pieces(np.zeros(2, int), both, area, False) == (40, 1)
    assert overhang(np.zeros(1, int), far, area) == 0


def test_a_table_on_one_leg_would_tip_over():
    top = [[0, 64], [56, 64], [0, 64]]
    leg = [[0, 8], [0, 56], [0, 8]]
    ends = np.array([top, leg])
    assert overhang(np.array([0, ACROSS_X | ACROSS_Z]), ends, EVERYWHERE) == 0
    assert overhang(np.array([0, 0]), ends, EVERYWHERE) == 2 * (32 - 8)
    assert overhang(np.array([0, ACROSS_Z]), ends, EVERYWHERE) == 32 - 8
    ends[1, [0, 2]] = 28, 36  # a pedestal
    assert overhang(np.array([0, 0]), ends, EVERYWHERE) == 0


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
        np.array([0, 4, 8, 12]), wrong,
    )  # fmt: skip
    assert wrong[0] == 0
    starts, spans = (part * MARGIN / 2 for part in (rays.starts, rays.spans))
    known = np.abs(spans).sum(axis=1) > 0
    for item, ends in ((1, whole[0]), (2, whole[0].clip(max=[[0], [1], [1]]))):
        met = np.empty(len(spans), bool)
        levels = np.rint((ends + 0.5) * LEVELS).astype(np.int64)
        meets(starts * LEVELS + LEVELS / 2, spans * LEVELS, BOX, 0, levels, met)
        assert wrong[item] == ((met != rays.hits) & known).sum() > 30


L_SHAPE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.0], [0.0, 0.0], [0.0, 0.5], [-0.5, 0.5]])
CELLS = 30


def standing(seen) -> np.ndarray:
    """A hull with this plan, between two heights."""
    hull = np.zeros((CELLS,) * 3, bool)
    hull[:, 4:9] = seen[:, None]
    return hull


def plan(shape: shapely.Polygon) -> np.ndarray:
    middles = (np.arange(CELLS) + 0.5) / CELLS - 0.5
    x, z = np.meshgrid(middles, middles, indexing="ij")
    return shapely.contains_xy(shape, x, z)


def test_an_outline_is_the_plan_of_the_hull():
    found = outline_of(standing(plan(shapely.Polygon(L_SHAPE))))
    shape, wanted = shapely.Polygon(found), shapely.Polygon(L_SHAPE)
    assert shape.symmetric_difference(wanted).area < 0.005
    assert all(found[:, axis].tolist().count(side) == 2 for axis in (0, 1) for side in (-0.5, 0.5))
    assert shapely.Polygon(found).exterior.is_ccw


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


def test_points_lie_within_and_cover_the_outline():
    points = points_within(L_SHAPE, 500)
    assert shapely.contains_xy(shapely.Polygon(L_SHAPE), points).all() and len(points) == 500
    shares = [((points > 0) == signs).all(axis=1).mean() for signs in ([0, 0], [0, 1], [1, 0])]
    assert min(shares) > 0.25
