"""A comparison of answers to single views, through the command: trained, scored, tabulated."""

import csv
import re
import shutil
from pathlib import Path

import h5py
import pytest
import yaml
from cli_helpers import call_here
from tiny_runs import tiny_baseline_settings, write_tiny_config
from typer.testing import CliRunner

from sceneprior.apps.cli.commands import app
from sceneprior.apps.experiments.compare import CompareOptions, compare, scoring_steps
from sceneprior.apps.experiments.comparison import load_comparison, runs_of
from sceneprior.apps.experiments.rows import rows_of
from sceneprior.apps.experiments.steps import StepRunner
from sceneprior.apps.experiments.table import VIEWS, Row, markdown
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.paper.fit_image import SCHEDULES, FitSchedule

SOFTWARE = CompareOptions()


def write_comparison(folder: Path, shards: Path, **changes) -> str:
    """A comparison's YAML of ours and USL on the toy rooms."""
    if not (folder / "tiny.yaml").is_file():
        write_tiny_config(folder / "tiny.yaml", shards, layout__epochs=1, shape__epochs=1)
        own = tiny_baseline_settings(Path("elsewhere"), "usl", training__epochs=1)
        (folder / "usl.yaml").write_text(yaml.safe_dump(own))
    data = {
        "task": "single_views",
        "seeds": [0],
        "count": 2,
        "views": 2,
        "cad_models": "shards",
        "rooms": {"toy": {"title": "Toys", "config": str(folder / "tiny.yaml")}},
        "methods": {"usl": {"title": "USL", "config": str(folder / "usl.yaml")}, "ours": {}},
    }
    (folder / "compare.yaml").write_text(yaml.safe_dump(data | changes, sort_keys=False))
    return str(folder / "compare.yaml")


def test_methods_are_trained_scored_and_tabulated(toy_shards, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(StepRunner, "call", call_here)
    path, out = write_comparison(tmp_path, toy_shards), tmp_path / "out"
    words = ["compare", "--config", path, "--out", str(out)]
    words += ["--methods", "usl"]  # a network that answers in one pass: ours has its own tests
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    table = (out / "table.md").read_text()
    assert "4 views of 2 test rooms of shards" in table and "Toys" in table
    assert (
        "of the objects have a CAD model that also occurs in training rooms; masks, classes"
        in table
    )
    assert "boxes are upright and along the room's axes" in table
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()
             if line.startswith("|")]  # fmt: skip
    head = lines[0]
    assert head[:6] == [
        "method",
        "shapes",
        "3D box IoU ↑",
        "CD (m) ↓",
        "F at 5 cm ↑",
        "s per image ↓",
    ]
    rows = {(line[0], line[1]): line[2:] for line in lines[2:] if len(line) == len(head)}
    found, cad = rows["USL", "as found"], rows["USL", "CAD models"]
    for cells in (found, cad):
        value, low, high = numbers(cells[0])
        assert 0 <= low <= value <= high <= 1
    assert float(found[3]) >= 0 and cad[3] == "–" and cad[1] != found[1]
    nearest, drawn = (rows[f"{name} training room{end}", "–"] for name, end in
                      (("Nearest", " by masks"), ("Random", "")))  # fmt: skip
    assert numbers(nearest[0])[0] > numbers(drawn[0])[0] and nearest[3] == "–"
    with (out / "table.csv").open() as file:
        told = list(csv.DictReader(file))
    assert [(row["method"], row["shapes"]) for row in told] == [
        ("USL", "as found"),
        ("USL", "CAD models"),
    ]
    before = (out / "toy" / "usl" / "seed0" / "scores.json").stat().st_mtime_ns
    assert CliRunner().invoke(app, words).exit_code == 0
    assert (out / "toy" / "usl" / "seed0" / "scores.json").stat().st_mtime_ns == before


def numbers(cell: str) -> list[float]:
    """A value and the ends of its interval."""
    return [float(number) for number in re.findall(r"[0-9.]+", cell)]


def test_a_run_that_remembers_rooms_has_a_row_for_each_fit(
    toy_shards, toy_run, tmp_path, monkeypatch
):
    monkeypatch.setitem(SCHEDULES, "paper", FitSchedule(steps=6, drop_at=3))
    path = write_comparison(tmp_path, toy_shards, fits=["paper", "objects"], cad_models=None)
    comparison = load_comparison(path)
    usl, ours = runs_of(comparison, tmp_path / "out")
    assert [s.arguments[-1] for s in scoring_steps(comparison, usl, 2, SOFTWARE)] == ["2"]
    steps = scoring_steps(comparison, ours, 2, SOFTWARE)
    assert [(step.name, *step.arguments[-2:]) for step in steps] == [
        ("scores", "--fit", "paper"),
        ("scores_objects", "--fit", "objects"),
    ]
    shutil.copytree(toy_run, ours.folder / "run")
    for step in steps:
        done = CliRunner().invoke(app, step.arguments)
        assert done.exit_code == 0, done.output
    rows = rows_of(comparison, ours)
    assert [row.title for row in rows] == [
        "Paper: fit of a latent",
        "Object by object, by the paper's prior",
    ]
    assert rows[0].scores["parameters"] and "parameters" not in rows[1].scores
    assert rows[0].scores["box_iou_3d"] != rows[1].scores["box_iou_3d"]


def test_the_command_of_a_run_says_all_that_its_scores_depend_on(toy_shards, tmp_path):
    comparison = load_comparison(write_comparison(tmp_path, toy_shards, sampling_seed=3))
    (step,) = scoring_steps(comparison, runs_of(comparison, tmp_path)[0], 2, SOFTWARE)
    words = " ".join(step.arguments)
    assert step.arguments[0] == "eval-svr" and f"--shards {toy_shards}" in words
    assert " ".join(step.depends_on) == (
        f"--split test --views 2 --seed 3 --limit 2 --models {toy_shards}"
    )
    without = load_comparison(write_comparison(tmp_path, toy_shards, cad_models=None, count=None))
    (step,) = scoring_steps(without, runs_of(without, tmp_path)[0], None, SOFTWARE)
    assert "--models" not in step.arguments and "--limit" not in step.arguments


def test_rooms_without_a_truth_are_refused_before_anything_is_trained(toy_shards, tmp_path):
    blind = shutil.copytree(toy_shards, tmp_path / "blind")
    for path in (blind / "test").glob("*.h5"):
        with h5py.File(path, "r+") as file:
            for room in file["rooms"].values():
                del room["ground_truth"]
    comparison = load_comparison(write_comparison(tmp_path, blind))
    with pytest.raises(InputError, match="Single views are compared with true rooms, and the"):
        compare(comparison, comparison, tmp_path / "out", SOFTWARE)
    assert not (tmp_path / "out" / "toy").exists()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"task": "nowhere"}, "no task is called 'nowhere'; choose from new_rooms, single_views"),
        ({"task": ["a"]}, r"no task is called '\['a'\]'"),
        ({"fits": ["guess"]}, "'fits.0': input should be 'objects' or 'paper'"),
        ({"task": "new_rooms"}, "unknown key 'views'"),
        (
            {"methods": {"a": {"title": "A", "scenes": {"toy": "b"}}}},
            "score existing scenes with `sceneprior eval-svr --scenes`",
        ),
    ],
)
def test_what_is_wrong_with_a_comparison_of_views_is_said(toy_shards, tmp_path, changes, said):
    with pytest.raises(ConfigError, match=said):
        load_comparison(write_comparison(tmp_path, toy_shards, **changes))


def test_surfaces_that_are_unknown_are_counted():
    scores = {
        "rooms": 3, "images": 3, "objects": 9, "with_surface": 4, "box_iou_3d": 0.5,
        "seconds": 0.25, "nearest_room": {"box_iou_3d": 0.2}, "random_room": {},
        "protocol": {"shards": "data/rooms", "known_model_share": None},
    }  # fmt: skip
    table = markdown([Row("Rooms", "2D", "A", "as found", 0, scores, "baselines")], VIEWS)
    assert (
        "of the lifted method: none; of baselines: 'A'. 3 views of 3 test rooms of rooms" in table
    )
    assert ", 9 objects (4 of them with a known surface); masks," in table
    assert "| A | as found | 0.500 | 0.250 |" in table
