"""Metrics of rooms' contents, compared with values by hand."""

import math

import numpy as np
import pytest
from toy_metrics import of_classes

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metrics.contents import (
    category_kl_of_counts,
    class_counts,
    common_label_set,
)


def kl(generated: list[Scene], test: list[Scene]) -> float:
    once = np.ones((0, len(generated)), int), np.ones((0, len(test)), int)
    return category_kl_of_counts(class_counts(generated), class_counts(test), *once).value


def test_category_kl_by_hand():
    test = [of_classes("double_bed", "nightstand"), of_classes("double_bed", "desk", "void")]
    generated = [of_classes("double_bed", "nightstand", "nightstand", "desk"), of_classes("void")]
    # test: bed 1/2, nightstand 1/4, desk 1/4; generated: 1/4, 1/2, 1/4
    by_hand = 0.5 * math.log(2) + 0.25 * math.log(1 / 2) + 0.25 * math.log(1)
    # The epsilon of 1e-6 moves each logarithm by at most 4e-6.
    assert kl(generated, test) == pytest.approx(by_hand, abs=4e-6)
    assert kl(test, test) == 0


def test_scenes_of_different_label_sets_are_not_compared():
    living = Scene("a", "front3d_living", ())
    with pytest.raises(
        InputError, match="but label sets front3d_bedroom, front3d_living were given"
    ):
        common_label_set([living], [of_classes("desk")])
    with pytest.raises(InputError, match="no scenes were given"):
        class_counts([])
