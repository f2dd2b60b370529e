"""Scores of made-up runs: what stands in which cell of the tables, and who made a row."""

import csv
import io
from dataclasses import replace

import pytest

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.makers import LIFTED, PAPER, maker_of_answers, maker_of_rooms
from sceneprior.apps.experiments.table import NEW_ROOMS, Row, as_csv, markdown

PROTOCOL = {"n_generated": 200, "n_test": 38, "n_train_rooms": 149, "shards": "front"}


def row(
    title, seed, fd, group="from masks in 2D", rooms="Bedrooms", latents="paper",
    made_by=PAPER.said, rank=0, **more
) -> Row:  # fmt: skip
    scores = {
        "protocol": PROTOCOL,
        "fd_effnet_lite0": fd,
        "category_kl": 0.1,
        "independent": {"fd_effnet_lite0": 61.0, "category_kl": 0.13},
        "independent_meshes": {"fd_effnet_lite0": 49.0},
        "train_rooms": {"fd_effnet_lite0": 39.0, "category_kl": 0.12},
        "shuffled": {"layout_classifier_accuracy": 0.81},
        **more,
    }
    scores |= {"cpu_s": 300.0 + 60 * seed, "steps": 4500, "parameters": 1_250_000}
    return Row(rooms, group, title, latents, seed, scores, made_by, rank)


@pytest.fixture
def rows() -> list[Row]:
    return [
        row("Ours", 0, 47.0, box_iou_3d=0.66),
        row("GAN_x", 0, 58.25),
        row("ATISS", 0, 44.0, "from boxes in 3D"),
        row("Ours", 1, 49.0, box_iou_3d=0.68),
    ]


def cells(table: str, name: str) -> dict[str, str]:
    lines = [line for line in table.splitlines() if line.startswith("|")]
    head, line = (
        [cell.strip() for cell in found.strip("|").split("|")]
        for found in (lines[0], next(x for x in lines if x.startswith(f"| {name} ")))
    )
    return dict(zip(head, line, strict=True))


def test_a_cell_is_the_mean_of_seeds_and_half_their_range(rows):
    table = markdown(rows, NEW_ROOMS)
    ours = cells(table, "Ours")
    assert ours["FD ↓"] == "48.0 ± 1.0" and ours["train box IoU ↑"] == "0.67 ± 0.01"
    assert (ours["steps"], ours["CPU min"], ours["parameters (M)"]) == ("4,500", "5.5", "1.25")
    gan = cells(table, "GAN_x")
    assert gan["FD ↓"] == "58.2" and gan["train box IoU ↑"] == "–"
    assert cells(table, "Independent objects, as boxes")["FD ↓"] == "61.0"
    furnished = cells(table, "Independent objects, with meshes")
    assert (furnished["FD ↓"], furnished["category KL ↓"]) == ("49.0", "–")
    real = cells(table, "Real training rooms")
    assert (real["FD ↓"], real["category KL ↓"], real["steps"]) == ("39.0", "0.120", "–")
    assert "FID ↓" not in table.splitlines()[4]  # nobody has it


def test_each_kind_of_rooms_has_a_table_that_says_what_it_is_of(rows):
    both = markdown([*rows, row("Ours", 0, 40.0, rooms="Living rooms")], NEW_ROOMS)
    assert both.index("### Bedrooms") < both.index("### Living rooms")
    assert "200 generated rooms per run against 38 test rooms of front; 149 real" in both
    assert "seeds 0, 1." in both and both.count("| method |") == 2


def test_the_csv_has_a_line_a_run_in_full_precision(rows):
    lines = list(csv.DictReader(io.StringIO(as_csv(rows, NEW_ROOMS))))
    assert [(line["method"], line["seed"]) for line in lines][-1] == ("Ours", "1")
    assert lines[1]["fd_effnet_lite0"] == "58.25" and lines[1]["box_iou_3d"] == ""
    assert lines[0]["cpu_s"] == "300.0"


def test_what_nobody_knows_is_left_open(rows):
    lost = replace(rows[1], scores={**rows[1].scores, "cpu_s": None})
    table = [rows[0], lost]
    assert cells(markdown(table, NEW_ROOMS), "GAN_x")["CPU min"] == "–"
    lines = list(csv.DictReader(io.StringIO(as_csv(table, NEW_ROOMS))))
    assert lines[1]["cpu_s"] == "" and lines[1]["steps"] == "4500"


def test_a_table_first_says_which_rows_are_the_papers_method_and_which_ours(rows):
    sampled = row("Lifted method: sampler", 0, 40.0, made_by=LIFTED)
    said = markdown([*rows, sampled], NEW_ROOMS).removeprefix("### Bedrooms\n\n")
    assert said.startswith(
        "Rows of the paper's method and variations of it: 'Ours', 'GAN_x', 'ATISS'; of the "
        "lifted method: 'Lifted method: sampler'. 200 generated rooms per run"
    )
    assert "of the lifted method: none." in markdown(rows, NEW_ROOMS)
    made_by = [
        line["made by"] for line in csv.DictReader(io.StringIO(as_csv([sampled], NEW_ROOMS)))
    ]
    assert made_by == ["the lifted method"]


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
