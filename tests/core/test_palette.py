import numpy as np
import pytest

from sceneprior.core.classes import LABEL_SETS, label_set
from sceneprior.core.palette import quiet_colors


@pytest.mark.parametrize("name", LABEL_SETS)
def test_the_classes_of_a_label_set_differ_quietly(name):
    colors = quiet_colors(label_set(name)).astype(int)
    apart = np.abs(colors[:, None] - colors[None]).max(axis=-1)
    assert apart[~np.eye(len(colors), dtype=bool)].min() >= 12
    high, low = colors.max(axis=1), colors.min(axis=1)
    assert ((high - low) <= 0.55 * high).all() and low.min() >= 64 and high.max() <= 240


def test_a_class_has_one_colour_in_all_label_sets_and_unknown_names_have_one_too():
    assert (quiet_colors(["sofa", "desk"])[::-1] == quiet_colors(["desk", "sofa"])).all()
    piano, harp = quiet_colors(["grand piano", "harp"])
    assert (piano != harp).any() and (piano == quiet_colors(["void", "grand piano"])[1]).all()
    assert quiet_colors([]).shape[0] == 0
