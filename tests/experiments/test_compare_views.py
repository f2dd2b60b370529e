"""A comparison of answers to single views, through the command: trained, scored, tabulated."""

import csv
import shutil
from pathlib import Path

import h5py
import pytest
import yaml
from PIL import Image
from tiny_runs import tiny_baseline_settings, write_tiny_config
from typer.testing import CliRunner

from sceneprior.cli import app
from sceneprior.config import load_config
from sceneprior.errors import ConfigError, InputError
from sceneprior.experiments.compare import compare
from sceneprior.experiments.comparison import ViewComparison, load_comparison, runs_of
from sceneprior.experiments.single_views import SingleViews
from sceneprior.experiments.table import markdown
from sceneprior.experiments.task import CompareOptions

SOFTWARE = CompareOptions("software")


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
        "cad_models": "shards",
        "rooms": {"toy": {"title": "Toys", "config": str(folder / "tiny.yaml")}},
        "methods": {
            "usl": {"title": "USL", "group": "2D", "config": str(folder / "usl.yaml")},
            "ours": {"title": "Ours", "group": "2D"},
        },
    }
    (folder / "compare.yaml").write_text(yaml.safe_dump(data | changes, sort_keys=False))
    return str(folder / "compare.yaml")


def test_methods_are_trained_scored_and_tabulated(toy_shards, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    path, out = write_comparison(tmp_path, toy_shards), tmp_path / "out"
    words = ["compare", "--config", path, "--out", str(out), "--renderer", "software"]
    words += ["--methods", "usl"]  # a network that answers in one pass: ours has its own tests
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 0, done.output
    table = (out / "table.md").read_text()
    assert "One view of each of 2 test rooms of shards" in table and "Toys" in table
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()
             if line.startswith("|")]  # fmt: skip
    head = lines[0]
    assert head[:6] == [
        "method",
        "shapes",
        "3D box IoU ↑",
        "CD (m) ↓",
        "F at 5 cm ↑",
        "s an image ↓",
    ]
    rows = {(line[0], line[1]): line[2:] for line in lines[2:] if len(line) == len(head)}
    found, cad = rows["USL", "as found"], rows["USL", "CAD models"]
    assert 0 <= float(found[0]) <= 1 and float(found[3]) >= 0 and cad[3] == "–"
    assert 0 <= float(cad[0]) <= 1 and cad[1] != found[1]
    nearest, drawn = (rows[f"{name} training room{end}", "–"] for name, end in
                      (("Nearest", " by masks"), ("Random", "")))  # fmt: skip
    assert float(nearest[0]) > float(drawn[0]) and nearest[3] == "–"
    with (out / "table.csv").open() as file:
        told = list(csv.DictReader(file))
    assert [(row["method"], row["shapes"]) for row in told] == [
        ("USL", "as found"),
        ("USL", "CAD models"),
    ]
    assert r"\begin{tabular}" in (out / "table.tex").read_text()
    with Image.open(out / "toy.png") as sheet:
        assert sheet.height > 2 * 150 and sheet.width > 5 * 150  # masks, and two times two
    before = (out / "toy" / "usl" / "seed0" / "scores.json").stat().st_mtime_ns
    assert CliRunner().invoke(app, words).exit_code == 0
    assert (out / "toy" / "usl" / "seed0" / "scores.json").stat().st_mtime_ns == before


def test_the_command_of_a_run_says_all_that_its_scores_depend_on(toy_shards, tmp_path):
    comparison = load_comparison(write_comparison(tmp_path, toy_shards, sampling_seed=3))
    assert isinstance(comparison, ViewComparison)
    (step,) = SingleViews(comparison, SOFTWARE).scoring(runs_of(comparison, tmp_path)[0])
    words = " ".join(step.arguments)
    assert step.arguments[0] == "eval-svr" and f"--shards {toy_shards}" in words
    assert " ".join(step.depends_on) == (
        f"--split test --seed 3 --renderer software --limit 2 --models {toy_shards}"
    )
    without = load_comparison(write_comparison(tmp_path, toy_shards, cad_models=None, count=None))
    (step,) = SingleViews(without, SOFTWARE).scoring(runs_of(without, tmp_path)[0])
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
        ({"distributions": ["paper"]}, "unknown key 'distributions'"),
        ({"count": 0}, "'count': input should be greater than or equal to 1"),
        ({"task": "new_rooms"}, "unknown key 'cad_models'"),
    ],
)
def test_what_is_wrong_with_a_comparison_of_views_is_said(toy_shards, tmp_path, changes, said):
    with pytest.raises(ConfigError, match=said):
        load_comparison(write_comparison(tmp_path, toy_shards, **changes))


def test_the_shipped_comparison_has_every_row_of_table_2():
    comparison = load_comparison("compare_svr.yaml")
    assert list(comparison.methods) == ["total3d", "im3d", "usl", "ours"]
    methods = [load_config(run.config, run.settings).method for run in runs_of(comparison, Path())]
    assert methods == list(comparison.methods) and comparison.cad_models == "shards"


def test_surfaces_that_are_unknown_are_counted():
    from sceneprior.experiments.single_views import VIEWS
    from sceneprior.experiments.table import Row

    scores = {
        "images": 3, "objects": 9, "with_surface": 4, "box_iou_3d": 0.5, "seconds": 0.25,
        "protocol": {"shards": "data/rooms"}, "nearest_room": {"box_iou_3d": 0.2},
        "random_room": {},
    }  # fmt: skip
    table = markdown([Row("Rooms", "2D", "A", "as found", 0, scores, {})], VIEWS)
    assert "3 test rooms of rooms, 9 objects (4 of them with a known surface);" in table
    assert "| A | as found | 0.500 | 0.250 |" in table
