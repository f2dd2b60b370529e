"""The card of a packed prior says what it was learnt from, how good it is, and its limits."""

import json
from dataclasses import replace

import pytest

from sceneprior.apps.api import load
from sceneprior.apps.priors.card import UNSTATED, model_card
from sceneprior.core.classes import label_set

SCORES = {
    "protocol": {"split": "test", "seed": 3, "resamples": 200, "n_generated": 50, "n_test": 4,
                 "n_train_rooms": 12, "n_shuffled": 12},
    "category_kl": 0.25,
    "intervals": {"generated": {"category_kl": [0.125, 0.5]}},
    "train_rooms": {"category_kl": 0.0625},
}  # fmt: skip


@pytest.fixture(scope="module")
def trained(sampler_run):
    return load(sampler_run).with_latents


def test_data_scores_and_limits_stand_in_it(trained, tmp_path):
    counts = {"train": {"rooms": 12, "views": 96, "objects": 40}}
    (tmp_path / "index.json").write_text(json.dumps({"label_set": "", "counts": counts}))
    data = trained.config.data.model_copy(update={"shards": str(tmp_path)})
    trained = replace(trained, config=trained.config.model_copy(update={"data": data}))
    card = model_card(trained, "tiny", "Made by **toys**, CC0.", SCORES, half=True)
    assert "# tiny\n" in card and "on 12 rooms. Rooms are sampled from: sampler" in card
    assert "Made by **toys**, CC0." in card and UNSTATED not in card
    assert "| train | 12 | 96 | 40 |" in card  # of the shards' index
    lines = card.splitlines()
    (head,) = [line for line in lines if "generated (50 rooms)" in line]
    assert head == "|  | generated (50 rooms) | real training (12 rooms) | real test (4 rooms) |"
    (row,) = [line for line in lines if line.startswith("| Category KL")]
    assert row.endswith("| 0.250, 0.125 to 0.500 | 0.062 | – |")
    assert "seed 3, against test rooms" in card and "200 bootstrap resamples" in card
    assert "does not contain the latents" in card and "half precision" in card
    assert "found in training masks" in card


def test_its_classes_are_those_that_can_be_asked_for(trained):
    card = model_card(trained, "tiny")
    names = label_set(trained.config.label_set)
    known = [names[row] for row in trained.sampler.drawn_classes]
    assert (
        f"Classes of generated objects (label set front3d_bedroom): {', '.join(known)}. The" in card
    )
    (rest,) = (line for line in card.splitlines() if "label set's other classes" in line)
    others = rest.rsplit(": ", 1)[1].removesuffix(".").split(", ")
    assert others and {*known, *others} == {*label_set("front3d_bedroom")} - {"void"}
    classes = label_set("front3d_bedroom")
    assert known == [classes[row] for row in trained.sampler.drawn_classes]
    without = model_card(replace(trained, sampler=None), "tiny")
    assert ", wardrobe." in without and "other classes" not in without


def test_what_is_not_known_is_said(trained):
    card = model_card(trained, "tiny", latents=True)
    assert UNSTATED in card and "Not measured when this was packed" in card
    assert "these rooms can be decoded from it" in card and "half precision" not in card
