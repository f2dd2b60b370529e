"""Improved precision and recall against their definition as loops."""

import numpy as np
import pytest

from sceneprior.evaluation.metrics.precision_recall import in_manifold


@pytest.mark.parametrize(("n", "m"), [(40, 30), (2, 30), (3, 2)])
def test_precision_and_recall_are_their_definition(two_sets, n, m):
    a, b = two_sets[0][:n], two_sets[1][:m]

    def inside(rows: np.ndarray, manifold: np.ndarray) -> list[bool]:
        answers = []
        for row in rows:
            hit = False
            for index, center in enumerate(manifold):
                others = [np.linalg.norm(x - center) for k, x in enumerate(manifold) if k != index]
                radius = sorted(others)[min(3, len(others)) - 1]
                hit = hit or np.linalg.norm(row - center) <= radius
            answers.append(hit)
        return answers

    precise, covered = in_manifold(a, b), in_manifold(b, a)
    assert precise.tolist() == inside(a, b) and covered.tolist() == inside(b, a)
    assert n < 40 or 0 < precise.mean() < 1 or 0 < covered.mean() < 1
