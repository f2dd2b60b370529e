"""What made a row, from the settings of its run."""

from pathlib import Path

import pytest

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.comparison import (
    load_comparison,
    maker_of,
    runs_of,
    variants_of,
)
from sceneprior.apps.experiments.makers import LIFTED, PAPER, maker_of_answers, maker_of_rooms


@pytest.mark.parametrize(
    ("name", "distribution", "title", "said"),
    [
        ("bedroom", "paper", "Paper's method", PAPER.said),
        ("bedroom", None, "Paper's method", PAPER.said),
        ("paper/bedroom_small", "kernel", "Paper's method", PAPER.said),
        (
            "lifted/bedroom",
            "paper",
            "Paper's sphere, taught by lifted boxes",
            "the paper's network and latents taught by lifted boxes",
        ),
        ("lifted/bedroom", None, "Lifted method: sampler", LIFTED),
        ("lifted/living", "sampler", "Lifted method: sampler", LIFTED),
        ("baselines/gan", None, "", "baselines"),
    ],
)
def test_a_config_and_a_distribution_say_what_makes_rooms(name, distribution, title, said):
    maker = maker_of_rooms(load_config(f"{name}.yaml"), distribution)
    assert (maker.title, maker.said) == (title, said)


def test_a_variation_is_called_by_its_own_title_and_by_what_it_learns_from():
    small, large = (
        load_config(f"{name}.yaml") for name in ("paper/bedroom_small", "lifted/bedroom")
    )
    assert maker_of_rooms(small, "paper").named("LSTM (c2)") == "LSTM (c2)"
    assert maker_of_rooms(large, "paper").named("LSTM (c2)") == "LSTM (c2), taught by lifted boxes"
    assert maker_of_rooms(large, "paper").title == "Paper's sphere, taught by lifted boxes"
    assert large.learns_from == "boxes lifted from masks in 2D"
    assert small.learns_from == "masks in 2D"


@pytest.mark.parametrize(
    ("name", "fit", "title", "said"),
    [
        ("lifted/bedroom_small", "objects", "Object by object", LIFTED),
        ("paper/bedroom_small", "objects", "Object by object, by the paper's prior", LIFTED),
        ("paper/bedroom_small", "paper", "Paper: fit of a latent", PAPER.said),
        (
            "lifted/bedroom_small",
            "paper",
            "Fit of a latent, taught by lifted boxes",
            "the paper's network and latents taught by lifted boxes",
        ),
    ],
)
def test_a_config_and_a_fit_say_what_answers_images(name, fit, title, said):
    maker = maker_of_answers(load_config(f"{name}.yaml"), fit)
    assert (maker.title, maker.said) == (title, said)


def test_a_baseline_answers_images_in_its_own_way():
    usl = load_config("baselines/usl.yaml")
    assert maker_of_answers(usl).said == "baselines" and usl.learns_from == "masks in 2D"


@pytest.mark.parametrize(
    ("name", "method", "rows"),
    [
        ("compare/new_rooms_small.yaml", "paper", ["Paper's method"] * 2),
        (
            "compare/new_rooms.yaml",
            "lifted",
            [
                "Lifted method: sampler",
                "Paper's sphere, taught by lifted boxes",
                "Paper's sphere, taught by lifted boxes",
            ],
        ),
        (
            "compare/single_view.yaml",
            "lifted",
            ["Fit of a latent, taught by lifted boxes", "Object by object"],
        ),
    ],
)
def test_the_shipped_comparisons_name_methods_by_their_configs(name, method, rows):
    comparison = load_comparison(name)
    assert comparison.methods[method].title is None
    run = next(run for run in runs_of(comparison, Path()) if run.method == method)
    made = [maker_of(comparison, run, variant) for variant in variants_of(comparison, run)]
    assert [maker.title for maker in made] == rows
