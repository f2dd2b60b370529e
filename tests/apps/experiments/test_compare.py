"""Comparisons: what is refused, which runs there are, and how a stopped one is continued."""

import errno
import shutil
from functools import partial
from pathlib import Path

import pytest
import torch
from made_results import write_comparison, write_new_rooms
from refusals import refused

from sceneprior.apps.api import Prior
from sceneprior.apps.cli.commands import app
from sceneprior.apps.config import load_any_run
from sceneprior.apps.experiments import commands, rows
from sceneprior.apps.experiments.compare import Compared, commands_of, compare, part_of
from sceneprior.apps.experiments.comparison import load_comparison, runs_of
from sceneprior.apps.experiments.rows import costs_of, rows_of
from sceneprior.apps.retrieval.cad_models import open_models
from sceneprior.apps.retrieval.retrieve import retrieve_all
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.core.files import write_json
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.paper.fit_image import SCHEDULES, FitSchedule

MAIN = partial(app, standalone_mode=False)
SHARED = ["-n", "4", "--seed", "0", "--boxes"]
"""Options of `eval-fid` that the rows of `write_comparison` share."""


@pytest.fixture
def written(toy_shards, tmp_path):
    return partial(write_comparison, tmp_path, toy_shards)


# -- Settings --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("key", {"seed": [0]}),
        ("seeds", {"seeds": [1, 1]}),
        ("title_twice", {"methods": {"a": {}, "b": {}}}),
        ("baseline_title", {"methods": {"a": {"config": "baselines/gan.yaml"}}}),
        ("rooms_of_set", {"methods": {"a": {"title": "A", "set": {"attic": []}}}}),
        ("key_of_set", {"methods": {"a": {"title": "A", "set": {"toy": ["model.widht=3"]}}}}),
        ("distributions", {"distributions": ["anywhere"]}),
        ("task", {"task": "nowhere"}),
        ("task_type", {"task": ["a"]}),
        ("fits", {"task": "single_views", "fits": ["guess"]}),
        ("key_of_task", {"task": "new_rooms", "views": 2}),
    ],
)
def test_a_wrong_comparison_is_refused_before_anything_runs(written, tmp_path, name, changes):
    path = written(**changes)
    with refused(f"apps/compare_{name}", ConfigError, tmp=tmp_path):
        load_comparison(path)


@pytest.mark.parametrize("task", ["single_views", "new_rooms"])
def test_rooms_without_a_truth_are_refused_before_anything_is_trained(bare, tmp_path, task):
    path = write_comparison(tmp_path, bare, task=task, cad_models="shards")
    comparison = load_comparison(path)
    with refused(f"apps/compare_blind_{task}", tmp=tmp_path):
        compare(comparison, runs_of(comparison, tmp_path / "out"), tmp_path / "out", MAIN)
    assert not (tmp_path / "out" / "toy").exists()


def test_a_part_keeps_the_order_and_names_what_there_is(written):
    comparison = load_comparison(written(seeds=[0, 1]))
    runs = part_of(comparison, Path("out"), "lstm, paper", "toy", "1")
    assert [(run.method, run.seed, run.folder) for run in runs] == [
        (name, 1, Path(f"out/toy/{name}/seed1")) for name in ("paper", "lstm")
    ]
    for name, given in {
        "method": ("gan", None, None), "seed": (None, None, "7"), "no_rooms": (None, ",", None),
    }.items():  # fmt: skip
        with refused(f"apps/compare_part_{name}"):
            part_of(comparison, Path(), *given)


# -- Runs that are continued -----------------------------------------------------------------------


@pytest.fixture
def begun(toy_run, toy_shards, tmp_path):
    """The toy run as a finished run of a comparison, with results that are made up."""
    change = partial(
        write_comparison, tmp_path, toy_shards, seeds=[3],
        rooms={"toy": {"title": "Toys", "config": str(tmp_path / "own.yaml")}},
    )  # fmt: skip
    shutil.copy(toy_run / "config.yaml", tmp_path / "own.yaml")
    comparison = load_comparison(change())
    run = runs_of(comparison, tmp_path / "out")[0]
    shutil.copytree(toy_run, run.folder / "run")
    for path in run.folder.rglob("final.ckpt"):  # kept runs are without optimizers
        torch.save(torch.load(path, weights_only=True) | {"optimizer_states": [{}]}, path)
    journal = {}
    for number, each in enumerate(commands_of(comparison, run, SHARED)):
        journal[each.name] = {
            "arguments": each.arguments, "depends_on": each.depends_on, "finished": True,
            "cpu_s": 2.5, "wall_s": 3.0, "peak_memory_gib": 0.5,
        }  # fmt: skip
        if each.name != "fit":
            write_new_rooms(each.result, number, each.arguments[-1], remembers=number == 1)
    write_json(run.folder / "steps.json", journal)
    return change


class Calls:
    """Stands in for the commands; says how each ends."""

    def __init__(self):
        self.arguments, self.error = [], None

    def __call__(self, main, arguments, log):
        self.arguments.append(arguments)
        if self.error is not None:
            raise self.error

    @property
    def names(self):
        return [words[0] for words in self.arguments]


@pytest.fixture
def calls(monkeypatch) -> Calls:
    calls = Calls()
    monkeypatch.setattr(commands, "call", calls)
    return calls


def again(begun, tmp_path, part: str | None = "paper", **changes) -> Compared:
    comparison = load_comparison(begun(**changes))
    return compare(comparison, part_of(comparison, tmp_path / "out", part), tmp_path / "out", MAIN)


def test_finished_commands_are_not_repeated_and_stay_in_the_table(begun, tmp_path, calls):
    run = runs_of(load_comparison(begun()), tmp_path / "out")[0]
    config, networks = run.run_config, load_any_run(run.folder / "run").prior
    assert costs_of(run) == {
        "cpu_s": 2.5, "parameters": sum(item.numel() for item in networks.parameters()),
        # 12 rooms in batches of 5 in the layout stage, then of 6.
        "steps": 3 * config.layout.epochs + 2 * config.shape.epochs,
    }  # fmt: skip
    done = again(begun, tmp_path)
    assert done == Compared(tmp_path / "out" / "table.md", [], []) and calls.names == []
    table = done.table.read_text()
    assert "| Paper's method | paper |" in table and "LSTM" not in table
    # A second method joins, and fails.
    calls.error = InputError("no room for more.")
    done = again(begun, tmp_path, None)
    assert calls.names == ["fit"] and done.failures == ["toy, lstm, seed 3: no room for more."]
    assert done.table.read_text() == table
    calls.error = OSError(errno.ENOSPC, "No space left on device")
    done = again(begun, tmp_path, None)
    assert done.failures[0].endswith("lstm/seed3 cannot be written (No space left on device)")
    # A deleted result is made again, with all that follows.
    (run.folder / "run/shape/final.ckpt").unlink()
    calls.arguments, calls.error = [], None
    again(begun, tmp_path)
    assert calls.names == ["fit", "evaluate", "evaluate"]


def test_a_run_of_before_gains_a_row_with_cad_models_and_nothing_else(begun, toy_shards, tmp_path):
    """Finished commands of a comparison without `cad_models` stay, and so do their rows."""
    before = again(begun, tmp_path, distributions=["paper"]).table.read_text()

    def titles(table):
        return [line.split(" |")[0] for line in table.splitlines() if line.startswith("| ")]

    options = EvalOptions(resamples=0)
    sample = Prior(load_any_run(tmp_path / "out/toy/paper/seed3/run"), "run").sample
    rooms = list(retrieve_all(sample(4, 0, "paper"), open_models(toy_shards, "front3d_bedroom")))
    by_hand = evaluate_synthesis(rooms, toy_shards, options)
    names = []

    def counted(words):
        names.append(words[0])
        return MAIN(words)

    comparison = load_comparison(begun(distributions=["paper"], cad_models="shards"))
    run, out = runs_of(comparison, tmp_path / "out")[0], tmp_path / "out"
    table = compare(comparison, [run], out, counted).table.read_text()
    assert names == ["eval-fid"]
    plain, cad, *_ = rows_of(comparison, run)
    assert cad.title == "Paper's method, with CAD models" and plain.rank == cad.rank
    assert cad.scores["protocol"]["models"] == toy_shards.name
    for key in ("fd_effnet_lite0", "recall_effnet_lite0", "sca_effnet_lite0"):
        assert cad.scores[key] == pytest.approx(by_hand[key]) and key in cad.scores["intervals"]
    # Boxes and layouts are those of the first row.
    assert not {"category_kl", "layout_classifier_accuracy", "fd_effnet_lite0_boxes"} & {
        *cad.scores, *cad.scores["intervals"]
    }  # fmt: skip
    # The older result has no shuffled rooms with meshes; the new one has.
    more = ["| Shuffled furniture, with meshes", f"| {cad.title}"]
    assert [line for line in titles(table) if line not in titles(before)] == more


def test_a_part_that_is_evaluated_otherwise_names_the_rows_it_leaves_out(begun, tmp_path, calls):
    done = again(begun, tmp_path, "lstm", count=5)
    assert done.table is None and done.left_out == ["toy, paper, seed 3"]
    assert calls.names == ["fit", "evaluate", "evaluate"]
    again(begun, tmp_path, "paper", count=None)
    assert calls.names[3:] == ["evaluate", "evaluate"]
    words = calls.arguments[-1]
    assert words[words.index("-n") + 1] == "12"  # as many as training rooms


def test_a_run_of_other_settings_is_named_and_left_as_it_is(begun, tmp_path, calls):
    done = again(begun, tmp_path, methods={"paper": {"set": {"every": ["shape.epochs=9"]}}})
    assert done.table is None and calls.names == []
    assert done.failures == [
        f"toy, paper, seed 3: {tmp_path}/out/toy/paper/seed3 holds a run with other settings "
        "than those of the comparison; delete it to train again, or name another --out."
    ]
    # The default distribution has no effect on training.
    changed = {"paper": {"set": {"every": ["sampling.distribution=kernel"]}}}
    assert again(begun, tmp_path, methods=changed).failures == [] and calls.names == []


def test_a_damaged_file_is_named(begun, tmp_path, calls):
    folder = tmp_path / "out" / "toy" / "paper" / "seed3"
    (folder / "scores.json").write_bytes((folder / "scores.json").read_bytes()[:40])
    with refused("apps/compare_damaged", tmp=tmp_path):
        again(begun, tmp_path)
    (folder / "steps.json").write_bytes((folder / "steps.json").read_bytes()[:40])
    (failure,) = again(begun, tmp_path).failures
    assert "seed3/steps.json is damaged; delete it and run the same command" in failure


def test_a_stopped_comparison_says_how_to_continue(command, written, calls, tmp_path):
    calls.error = KeyboardInterrupt()
    status, _, errors = command("compare", "--config", written(), "--out", tmp_path / "out")
    assert status == 130, errors
    assert errors.endswith("Stopped. Run the same command again to continue.\n")
    assert calls.names == ["fit"] and not (tmp_path / "out" / "table.md").exists()


def test_a_fit_of_single_views_is_scored_and_tabulated(toy_run, toy_shards, tmp_path, monkeypatch):
    monkeypatch.setitem(SCHEDULES, "paper", FitSchedule(steps=6, drop_at=3))
    path = write_comparison(
        tmp_path, toy_shards, task="single_views", fits=["paper"], cad_models=None, count=1
    )
    comparison = load_comparison(path)
    run = runs_of(comparison, tmp_path / "out")[0]
    shutil.copytree(toy_run, run.folder / "run")
    monkeypatch.setattr(rows, "costs_of", lambda run: {"parameters": 7})
    shared = comparison.shared_options(toy_shards, None)
    scoring = commands_of(comparison, run, shared)[-1]
    commands.call(MAIN, scoring.arguments, tmp_path / "log")
    (row,) = rows_of(comparison, run)
    assert row.title == "Paper: fit of a latent" and row.scores["parameters"]
    assert row.scores["images"] == 2 and row.scores["seconds"] > 0
