"""Label sets, the classes of models, colours, and seeds."""

import pytest

import sceneprior
from sceneprior.core.classes import LABEL_SETS, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.furniture import class_of_category
from sceneprior.core.repeatable import LARGEST_SEED, check_seed
from sceneprior.core.scene import Scene


def test_the_papers_sets():
    assert {name: len(label_set(name)) for name in LABEL_SETS} == {
        "front3d_bedroom": 22, "front3d_living": 15, "scannet": 19,
        "front3d_dining": 15, "front3d_library": 15, "front3d_kitchen": 9, "front3d_all": 22,
    }  # fmt: skip
    assert all(classes[0] == "void" for classes in LABEL_SETS.values())


@pytest.mark.parametrize(
    ("category", "name", "wanted"),
    [
        ("king-size bed", "front3d_bedroom", "double_bed"),
        ("children cabinet", "front3d_bedroom", "children_cabinet"),
        ("children cabinet", "front3d_living", "cabinet"),
        ("children cabinet", "front3d_all", "children_cabinet"),
        ("barstool", "front3d_bedroom", "void"),
        ("barstool", "front3d_all", "stool"),
        ("children cabinet", "scannet", "cabinet"),  # no children_cabinet there
        ("king-size bed", "scannet", "void"),
        ("king-size bed", "void,king-size bed,table", "king-size bed"),  # the category's own name
        ("dining table", "void,king-size bed,table", "table"),
        ("others", "front3d_bedroom", "void"),
        ("flying saucer", "front3d_bedroom", "void"),
    ],
)
def test_classes_of_categories(category, name, wanted):
    assert class_of_category(category, name) == wanted


TWENTY_DIGITS = 10**20 - 1


@pytest.fixture(scope="module", params=["sampler_run", "toy_run"])
def prior(request):
    return sceneprior.load(request.getfixturevalue(request.param))


def test_a_seed_is_a_number_of_32_bits(prior):
    check_seed(0)
    check_seed(LARGEST_SEED)
    assert prior.sample(1, LARGEST_SEED)[0].name == f"seed{LARGEST_SEED}_0000"
    empty = Scene("empty", "front3d_bedroom")
    for seed in (-1, LARGEST_SEED + 1, TWENTY_DIGITS):
        said = rf"The seed is {seed}; expected a whole number from 0 to {LARGEST_SEED}\."
        with pytest.raises(InputError, match=said):
            prior.sample(1, seed)
        with pytest.raises(InputError, match=said):
            prior.complete(empty, 1, seed)
    with pytest.raises(InputError, match=f"The seed is {TWENTY_DIGITS}"):
        prior.latent(f"seed:{TWENTY_DIGITS}")
