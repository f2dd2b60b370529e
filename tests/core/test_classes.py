"""Label sets, shipped and of one's own, and the colours of their classes."""

import numpy as np
import pytest

from sceneprior.core.classes import LABEL_SETS, class_colors, label_set, label_set_name
from sceneprior.core.errors import InputError
from sceneprior.render.appearance import quiet_colors
from sceneprior.render.topdown import topdown_protocol


def test_the_papers_sets():
    assert {name: len(label_set(name)) for name in LABEL_SETS} == {
        "front3d_bedroom": 22, "front3d_living": 15, "scannet": 19,
        "front3d_dining": 15, "front3d_library": 15, "front3d_kitchen": 9, "front3d_all": 22,
    }  # fmt: skip
    assert all(classes[0] == "void" for classes in LABEL_SETS.values())


def test_a_list_of_ones_own_is_its_own_name():
    name = label_set_name(["bed", "night stand"])
    assert name == "void,bed,night stand"
    assert label_set(name) == ("void", "bed", "night stand")
    assert len(class_colors(len(label_set(name)))) == 3
    assert topdown_protocol(name).window_m == 12.8


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("attic", "No label set is called 'attic'; there are front3d_bedroom, front3d_living, "
         "scannet, front3d_dining, front3d_library, front3d_kitchen, front3d_all, or write your "
         "own as void,bed,chair."),
        ("void,bed,bed", "The class 'bed' is in the label set twice; list it once."),
        ("void,", "'' is not a class name; expected 1 to 60 printable characters, without a "
         "space at either end."),
        ("void," + "x" * 61, "is not a class name; expected 1 to 60 printable characters"),
    ],
)  # fmt: skip
def test_what_is_no_label_set(name, said):
    with pytest.raises(InputError) as error:
        label_set(name)
    assert said in str(error.value)


def test_what_is_no_list_of_names():
    with pytest.raises(InputError, match="The class name 'bed, large' has a comma, which sep"):
        label_set_name(["bed, large"])
    with pytest.raises(InputError, match=r"A label set needs at least one class in addition to"):
        label_set_name([])


def test_colours_differ():
    colors = class_colors(22)
    assert len(np.unique(colors, axis=0)) == 22 and colors[0].tolist() == [128, 128, 128]


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
