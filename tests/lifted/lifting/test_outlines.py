"""Outlines from above: as hulls have them, of few corners, and what they leave of rays."""

import numpy as np
import pytest
import shapely

from sceneprior.core.parts import MOST_CORNERS, SQUARE
from sceneprior.lifted.lifting.part_regularizers import cut_rays, outline_of, points_within

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


def test_ragged_outlines_are_simplified_until_they_have_few_corners():
    rng = np.random.default_rng(0)
    ragged = plan(shapely.Polygon(SQUARE))
    depth = rng.integers(0, 8, CELLS)
    for column, missing in enumerate(depth):
        ragged[column, CELLS - missing :] = False
    assert len(outline_of(standing(ragged))) <= MOST_CORNERS


@pytest.mark.parametrize("seen", [np.zeros((CELLS, CELLS), bool), np.ones((CELLS, CELLS), bool)])
def test_full_and_empty_hulls_have_the_square(seen):
    assert outline_of(standing(seen)) is SQUARE
    seen[:1, :2] = True
    assert outline_of(standing(seen)) is SQUARE


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
