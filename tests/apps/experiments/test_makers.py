"""Columns that say how a row of a table was made, from the settings of its run."""

import pytest

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.makers import LIFTED, PAPER, maker_of_answers, maker_of_rooms


@pytest.mark.parametrize(
    ("name", "distribution", "title", "said"),
    [
        ("bedroom", None, "Paper's method", PAPER.said),
        ("paper/bedroom_small", "kernel", "Paper's method", PAPER.said),
        (
            "lifted/bedroom",
            "paper",
            "Paper's sphere, trained on lifted boxes",
            "the paper's network and latents trained on lifted boxes",
        ),
        ("lifted/living", "sampler", "Lifted method: sampler", LIFTED),
        ("baselines/gan", None, "", "baselines"),
    ],
)
def test_a_config_and_a_distribution_say_what_makes_rooms(name, distribution, title, said):
    maker = maker_of_rooms(load_config(f"{name}.yaml"), distribution)
    assert (maker.title, maker.said) == (title, said)


@pytest.mark.parametrize(
    ("name", "fit", "title", "said"),
    [
        ("lifted/bedroom_small", "objects", "Object by object", LIFTED),
        ("paper/bedroom_small", "objects", "Object by object, by the paper's prior", LIFTED),
        ("paper/bedroom_small", "paper", "Paper: fit of a latent", PAPER.said),
        (
            "lifted/bedroom_small",
            "paper",
            "Fit of a latent, trained on lifted boxes",
            "the paper's network and latents trained on lifted boxes",
        ),
    ],
)
def test_a_config_and_a_fit_say_what_answers_images(name, fit, title, said):
    maker = maker_of_answers(load_config(f"{name}.yaml"), fit)
    assert (maker.title, maker.said) == (title, said)
