"""A comparison of tiny runs, through the command: trained, judged, gone on with, tabulated."""

import json
from pathlib import Path

import pytest
import yaml
from PIL import Image
from tiny_runs import write_tiny_config

from sceneprior.errors import InputError
from sceneprior.stages.runs import load_any_run
from sceneprior.tasks import compare as module
from sceneprior.tasks.compare import compare, costs_of
from sceneprior.tasks.comparison import load_comparison, part_of, runs_of


@pytest.fixture
def written(toy_shards, tmp_path):
    """A comparison's YAML of one kind of room and two methods, and how to change it."""
    config = write_tiny_config(
        tmp_path / "tiny.yaml", toy_shards, layout__epochs=1, shape__epochs=1
    )
    data = {
        "seeds": [0],
        "count": 4,
        "rooms": {"toy": {"title": "Toys", "config": str(config)}},
        "methods": {
            "ours": {"title": "Ours", "group": "2D"},
            "lstm": {
                "title": "LSTM",
                "group": "2D",
                "set": {"every": ["model.decoder=lstm"], "toy": ["model.width=8"]},
            },
        },
    }

    def write(**changes) -> str:
        path = tmp_path / "compare.yaml"
        path.write_text(yaml.safe_dump(data | changes, sort_keys=False))
        return str(path)

    return write


def test_every_run_has_its_settings_its_seed_and_its_folder(written):
    comparison = load_comparison(written(seeds=[0, 1]))
    runs = runs_of(comparison, Path("out"))
    assert [(run.method, run.seed) for run in runs] == [
        ("ours", 0), ("lstm", 0), ("ours", 1), ("lstm", 1),
    ]  # fmt: skip
    assert runs[3].settings == ("model.decoder=lstm", "model.width=8", "seed=1")
    assert runs[3].folder == Path("out/toy/lstm/seed1")


def test_the_shipped_comparison_has_every_method_of_the_paper():
    comparison = load_comparison("compare_front_small.yaml")
    wanted = {"ours", "lstm", "atiss2d", "gan", "atiss3d", "sync2gen", "c1", "c3", "views25"}
    assert wanted < set(comparison.methods) and set(comparison.rooms) == {"bedroom", "living"}


def test_a_part_keeps_the_order_and_names_what_there_is(written):
    comparison = load_comparison(written(seeds=[0, 1]))
    part = part_of(comparison, "lstm, ours", "toy", "1")
    assert tuple(part.methods) == ("ours", "lstm") and part.seeds == (1,)
    with pytest.raises(InputError, match="No method 'gan' in this comparison; it has ours, lstm"):
        part_of(comparison, "gan", None, None)
    with pytest.raises(InputError, match="No seed '7'"):
        part_of(comparison, None, None, "7")
    with pytest.raises(InputError, match="No kind of rooms was named"):
        part_of(comparison, None, ",", None)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seed": [0]}, "unknown key 'seed'; the nearest valid key is 'seeds'"),
        ({"seeds": [1, 1]}, "seeds are numbers from 0 on, each once"),
        (
            {"methods": {"a": {"title": "A", "grp": "2D", "group": "2D"}}},
            "unknown key 'methods.a.grp'; the nearest valid key is 'group'",
        ),
        (
            {"methods": {"a": {"title": "A", "group": "2D", "set": {"attic": []}}}},
            "methods.a.set has 'attic'; expected every or one of toy",
        ),
        (
            {"methods": {"a": {"title": "A", "group": "b", "set": {"toy": ["model.widht=3"]}}}},
            "unknown key 'model.widht'; the nearest valid key is 'width'",
        ),
    ],
)
def test_what_is_wrong_with_a_comparison_is_said_before_anything_runs(written, changes, message):
    with pytest.raises(InputError, match=message):
        load_comparison(written(**changes))


def test_runs_are_trained_judged_tabulated_and_not_repeated(written, tmp_path, monkeypatch):
    comparison = load_comparison(written())
    out = tmp_path / "out"
    part = part_of(comparison, "ours", None, None)
    assert compare(comparison, part, out, 1, "software") == []
    folder = out / "toy" / "ours" / "seed0"
    noted = json.loads((folder / "steps.json").read_text())
    assert noted["fit"]["finished"] and noted["fit"]["cpu_s"] > 0
    assert noted["fit"]["arguments"][:2] == ["fit", "--config"]
    costs = costs_of(folder)
    assert costs.steps == 3 + 2  # 12 rooms in batches of 5, then of 6
    count = sum(item.numel() for item in load_any_run(folder / "run").prior.parameters())
    assert costs.parameters == count
    table = (out / "table.md").read_text()
    assert "| Ours |" in table and "LSTM" not in table and "4 generated rooms" in table
    with Image.open(out / "toy.png") as sheet:
        assert sheet.height == 3 * 160  # real, independent, ours

    # A second method joins; the first is neither trained nor judged again, and stays in the table.
    called = []

    def failing(arguments, log, jobs):
        called.append(arguments[0])
        log.write_text("working\nError: no room for more.\n")
        return 2, 1.0, 1.0

    monkeypatch.setattr(module, "_call", failing)
    failures = compare(comparison, comparison, out, 2, "software")
    assert called == ["fit"]
    assert failures == ["toy, lstm, seed 0: no room for more."]
    assert "| Ours |" in (out / "table.md").read_text()


def test_scores_of_a_run_that_was_there_before_are_not_taken_for_the_new_ones(
    written, tmp_path, monkeypatch
):
    called = []

    def working(arguments, log, jobs):
        called.append(arguments[0])
        run = Path(arguments[arguments.index("--run") + 1])
        run.mkdir(exist_ok=True)
        (run / "config.yaml").touch()
        return 0, 2.0, 1.0

    monkeypatch.setattr(module, "_call", working)
    monkeypatch.setattr(module, "write_tables", lambda rows, out: None)
    monkeypatch.setattr(module, "_rows", lambda comparison, done: [])
    monkeypatch.setattr(module, "write_figure", lambda *given: None)
    methods = {"ours": {"title": "Ours", "group": "2D"}}
    before = load_comparison(written(methods=methods))
    compare(before, before, tmp_path / "out", 1, "software")
    compare(before, before, tmp_path / "out", 1, "software")
    assert called == ["fit", "eval-fid"]
    methods["ours"]["set"] = {"every": ["model.width=8"]}
    after = load_comparison(written(methods=methods))
    compare(after, after, tmp_path / "out", 1, "software")
    assert called[2:] == ["fit", "eval-fid"]
    more = load_comparison(written(methods=methods, count=5))
    compare(more, more, tmp_path / "out", 1, "software")
    assert called[4:] == ["eval-fid"]


def test_a_command_that_failed_is_told_by_its_own_sentence(tmp_path):
    log = tmp_path / "fit.log"
    log.write_text("10%\nError: ValueError: odd.\nThis should not happen. Run again.\n")
    assert module._reason(log) == "ValueError: odd."
    log.write_text("\n 73% Killed\n")
    assert module._reason(log) == "73% Killed"
    log.write_text("")
    assert module._reason(log) == f"it said nothing in {log}"


def test_a_stopped_comparison_says_so_and_keeps_what_the_run_took(written, tmp_path, monkeypatch):
    comparison = load_comparison(written())

    def stopped(arguments, log, jobs):
        run = Path(arguments[arguments.index("--run") + 1])
        run.mkdir(exist_ok=True)
        (run / "config.yaml").touch()
        return 130, 2.5, 3.0

    monkeypatch.setattr(module, "_call", stopped)
    for times in (1, 2):
        with pytest.raises(KeyboardInterrupt):
            compare(comparison, comparison, tmp_path / "out", 1, "software")
        noted = json.loads((tmp_path / "out/toy/ours/seed0/steps.json").read_text())
        assert noted["fit"]["cpu_s"] == 2.5 * times and not noted["fit"]["finished"]
    assert not (tmp_path / "out" / "table.md").exists()
