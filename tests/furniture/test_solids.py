"""Solids: their sizes, volumes and places."""

import numpy as np
import pytest

from sceneprior.furniture import solids


@pytest.mark.parametrize(
    ("solid", "low", "high"),
    [
        (solids.box(1, 2, 3, 4, 5, 6), (3.5, 5, 4.5), (4.5, 7, 7.5)),
        (solids.beveled_box(1, 2, 3, 4, 5, 6), (3.5, 5, 4.5), (4.5, 7, 7.5)),
        (solids.cylinder(1, 2, 3, 4, 5), (2, 4, 4), (4, 6, 6)),
        (solids.torus(1, 0.2, 3), (-1, 3, -1), (1, 3.2, 1)),
        (solids.panel(solids.arch(2, 3, 2, steps=11), 0.5, 1), (-1, 0, 0.75), (1, 3, 1.25)),
        (
            solids.shifted(solids.tilted(solids.box(2, 4, 6), np.pi / 2), 1, 2, 3),
            (0, -1, 3),
            (2, 5, 7),
        ),
        (solids.scaled(solids.box(1, 1, 1), [1, 2, 3]), (-0.5, 0, -1.5), (0.5, 2, 1.5)),
    ],
)
def test_solids_are_closed_and_stand_where_they_should(solid, low, high):
    assert solid.is_watertight and solid.is_winding_consistent and solid.volume > 0
    np.testing.assert_allclose(solid.bounds, [low, high], atol=1e-12)


def test_fitted_parts_fill_the_size_together():
    parts = solids.fit_to([solids.box(1, 1, 1), solids.box(1, 1, 1, x=2)], (6, 2, 1))
    np.testing.assert_allclose(parts[0].bounds, [[-3, 0, -0.5], [-1, 2, 0.5]], atol=1e-12)
    np.testing.assert_allclose(parts[1].bounds, [[1, 0, -0.5], [3, 2, 0.5]], atol=1e-12)
