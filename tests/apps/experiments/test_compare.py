"""A comparison of tiny runs, through the command: trained, judged, gone on with, tabulated."""

import json
import shutil
from functools import partial
from operator import attrgetter
from pathlib import Path

import pytest
import yaml
from cli_helpers import call_here
from tiny_runs import tiny_baseline_settings, write_tiny_config
from toy_metrics import without_classifiers

from sceneprior.apps.config import load_any_run, load_config
from sceneprior.apps.experiments.compare import Compared, CompareOptions, compare, scoring_steps
from sceneprior.apps.experiments.comparison import (
    load_comparison,
    part_of,
    runs_of,
    shards_of,
    variants_of,
)
from sceneprior.apps.experiments.rows import costs_of
from sceneprior.apps.experiments.steps import StepRunner
from sceneprior.core.errors import InputError

SOFTWARE = CompareOptions()
METHODS = {
    "ours": {},
    "lstm": {
        "title": "LSTM",
        "set": {"every": ["model.decoder={name: lstm}"], "toy": ["model.width=8"]},
    },
}


def write_comparison(folder: Path, shards: Path, **changes) -> str:
    """A comparison's YAML of one kind of room and two methods."""
    config = folder / "tiny.yaml"
    if not config.is_file():
        write_tiny_config(config, shards, layout__epochs=1, shape__epochs=1)
    data = {
        "seeds": [0],
        "count": 4,
        "rooms": {"toy": {"title": "Toys", "config": str(config)}},
        "methods": METHODS,
    }
    path = folder / "compare.yaml"
    path.write_text(yaml.safe_dump(data | changes, sort_keys=False))
    return str(path)


@pytest.fixture
def written(toy_shards, tmp_path):
    return partial(write_comparison, tmp_path, toy_shards)


def test_every_run_has_its_settings_its_seed_and_its_folder(written):
    comparison = load_comparison(written(seeds=[0, 1]))
    runs = runs_of(comparison, Path("out"))
    assert [(run.method, run.seed) for run in runs] == [
        ("ours", 0), ("lstm", 0), ("ours", 1), ("lstm", 1),
    ]  # fmt: skip
    assert runs[3].settings == ("model.decoder={name: lstm}", "model.width=8", "seed=1")
    assert runs[3].folder == Path("out/toy/lstm/seed1")


def test_rooms_change_the_config_that_methods_share(written, tmp_path):
    rooms = {"title": "Toys", "config": str(tmp_path / "tiny.yaml")}
    changes = ["data.shards=large", "model.max_objects=2", "layout.epochs=9"]
    kinds = {"toy": rooms, "more": {**rooms, "title": "More", "set": changes}}
    own = tmp_path / "gan.yaml"
    own.write_text(yaml.safe_dump(tiny_baseline_settings(Path("elsewhere"), "gan")))
    trained = {
        "ours": {},
        "lstm": {**METHODS["lstm"], "set": {"more": ["layout.epochs=8"]}},
        "gan": {"title": "GAN", "config": str(own)},
    }
    theirs = {"theirs": {"title": "Theirs", "scenes": {"more": "theirs"}}}
    comparison = load_comparison(written(rooms=kinds, methods=trained | theirs))
    runs = {(run.rooms, run.method): run for run in runs_of(comparison, Path())}
    configs = {key: run.run_config for key, run in runs.items()}
    assert {key: config.layout.epochs for key, config in configs.items() if key[1] != "gan"} == {
        ("toy", "ours"): 1, ("toy", "lstm"): 1, ("more", "ours"): 9, ("more", "lstm"): 8,
        ("more", "theirs"): 9,
    }  # fmt: skip
    assert {configs["more", name].model.max_objects for name in trained} == {2}
    assert {configs["more", name].data.shards for name in trained} == {"large"}
    assert shards_of(comparison, "more") == Path("large") != shards_of(comparison, "toy")
    (step,) = scoring_steps(comparison, runs["more", "theirs"], 4, SOFTWARE)
    assert step.arguments[step.arguments.index("--shards") + 1] == "large"


def test_a_method_with_a_config_of_its_own_learns_from_the_same_rooms(written, tmp_path):
    own = tmp_path / "gan.yaml"
    settings = tiny_baseline_settings(Path("elsewhere"), "gan", model__max_objects=3)
    own.write_text(yaml.safe_dump(settings | {"label_set": "void,bed"}))
    changes = {"every": ["training.epochs=7"]}
    gan = {"title": "GAN", "config": str(own), "set": changes}
    comparison = load_comparison(written(methods={"ours": METHODS["ours"], "gan": gan}))
    ours, other = runs_of(comparison, Path())
    assert (ours.config, ours.settings) == (str(tmp_path / "tiny.yaml"), ("seed=0",))
    assert other.config == str(own)
    theirs, mine = (load_config(run.config, run.settings) for run in (ours, other))
    assert (mine.method, mine.training.epochs) == ("gan", 7)
    for name in ("label_set", "seed", "model.max_objects", "data.shards"):
        assert attrgetter(name)(mine) == attrgetter(name)(theirs), name
    # No config but ours has to have room for a number of objects.
    own.write_text("method: sync2gen\nlabel_set: a\nseed: 1\n")
    assert runs_of(comparison, Path())[1].settings == (
        'label_set="front3d_bedroom"',
        f'data.shards="{theirs.data.shards}"',
        "training.epochs=7",
        "seed=0",
    )
    own.unlink()
    with pytest.raises(InputError, match=r"No config '.*gan\.yaml'"):
        load_comparison(str(tmp_path / "compare.yaml"))


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
        ({"seeds": [1, 1]}, "seeds must be distinct integers of at least 0"),
        (
            {"methods": {"a": {}, "b": {}}},
            "the title 'Paper's method' is given twice; a title names a row, so give methods.a",
        ),
        (
            {"methods": {"a": {"title": "A", "scenes": {"attic": "b"}}}},
            "methods.a.scenes has 'attic'; expected one of toy",
        ),
        (
            {"methods": {"a": {"title": "A", "scenes": {"toy": "b"}, "config": "c.yaml"}}},
            "scenes are evaluated as they are, so `config` and `set` have no effect on them",
        ),
        (
            {"methods": {"a": {"scenes": {"toy": "b"}}}},
            "scenes need a title, since no config names their method",
        ),
        (
            {"methods": {"a": {"config": "baselines/gan.yaml"}}},
            "methods.a has no title; only the paper's and the lifted method are named by their "
            "configs",
        ),
        (
            {"methods": {"a": {"title": "A", "set": {"attic": []}}}},
            "methods.a.set has 'attic'; expected every or one of toy",
        ),
        (
            {"methods": {"a": {"title": "A", "set": {"toy": ["model.widht=3"]}}}},
            "unknown key 'model.widht'; the nearest valid key is 'model.width'",
        ),
    ],
)
def test_what_is_wrong_with_a_comparison_is_said_before_anything_runs(written, changes, message):
    with pytest.raises(InputError, match=message):
        load_comparison(written(**changes))


@pytest.fixture(scope="module")
def trained(toy_shards, tmp_path_factory) -> Path:
    """`ours` of the comparison below, trained and judged."""
    folder = tmp_path_factory.mktemp("compared")
    comparison = load_comparison(write_comparison(folder, toy_shards))
    part = part_of(comparison, "ours", None, None)
    with pytest.MonkeyPatch.context() as patch:
        without_classifiers(patch)
        patch.setattr(StepRunner, "call", call_here)
        done = compare(comparison, part, folder / "out", SOFTWARE)
    assert done == Compared(folder / "out" / "table.md", [], [])
    return folder


@pytest.fixture
def begun(trained, toy_shards, tmp_path) -> Path:
    """A copy of it, to go on with: nothing in it knows where it lies."""
    shutil.copytree(trained, tmp_path / "copy")
    write_comparison(tmp_path / "copy", toy_shards)
    return tmp_path / "copy"


class Calls:
    """Stands in for the commands; says how each ends."""

    def __init__(self, status=0, before=lambda arguments: None):
        self.names, self.status, self.before = [], status, before

    def __call__(self, runner, arguments, log):
        self.names.append(arguments[0])
        self.before(arguments)
        log.write_text("working\nError: no room for more.\n")
        return self.status, {"cpu_s": 2.5, "wall_s": 3.0, "peak_memory_gib": 0.5}


@pytest.fixture
def calls(monkeypatch) -> Calls:
    calls = Calls()
    monkeypatch.setattr(StepRunner, "call", lambda *given: calls(*given))
    return calls


def again(begun: Path, toy_shards: Path, part: str | None = "ours", **changes) -> Compared:
    comparison = load_comparison(write_comparison(begun, toy_shards, **changes))
    return compare(comparison, part_of(comparison, part, None, None), begun / "out", SOFTWARE)


def test_a_run_is_trained_judged_and_tabulated(trained, toy_shards):
    comparison = load_comparison(write_comparison(trained, toy_shards))
    run = runs_of(comparison, trained / "out")[0]
    noted = json.loads((run.folder / "steps.json").read_text())
    assert noted["fit"]["finished"] and noted["fit"]["cpu_s"] > 0
    assert noted["fit"]["arguments"][:2] == ["fit", "--config"]
    assert "--devices 1 --resume" in " ".join(noted["fit"]["arguments"])
    costs = costs_of(run)
    assert costs["steps"] == 3 + 2  # 12 rooms in batches of 5, then of 6
    count = sum(item.numel() for item in load_any_run(run.folder / "run").prior.parameters())
    assert (costs["parameters"], costs["cpu_s"]) == (count, noted["fit"]["cpu_s"])
    table = (trained / "out" / "table.md").read_text()
    assert "LSTM" not in table and "4 generated rooms" in table
    latents = [
        line.split(" | ")[1] for line in table.splitlines() if line.startswith("| Paper's method ")
    ]
    assert latents == ["paper", "of training rooms, decoded", "kernel, copies: near training rooms"]
    assert {"scores.json", "scores_kernel.json"} < {path.name for path in run.folder.iterdir()}


def test_what_is_done_is_not_repeated_and_stays_in_the_table(begun, toy_shards, calls):
    assert again(begun, toy_shards).failures == [] and calls.names == []
    # A second method joins, and fails.
    calls.status = 2
    done = again(begun, toy_shards, None)
    assert calls.names == ["fit"] and done.failures == ["toy, lstm, seed 0: no room for more."]
    assert "| Paper's method |" in (begun / "out" / "table.md").read_text()


def test_a_part_that_is_judged_otherwise_names_the_rows_it_leaves_out(begun, toy_shards, calls):
    done = again(begun, toy_shards, "lstm", count=5)
    assert done.table is None and done.left_out == ["toy, ours, seed 0"]
    assert calls.names == ["fit", "eval-fid", "eval-fid"]
    again(begun, toy_shards, "ours", count=5)
    assert calls.names[3:] == ["eval-fid", "eval-fid"]


def test_without_a_count_as_many_rooms_are_made_as_are_trained_on(begun, toy_shards, calls):
    said = []
    calls.before = said.append
    again(begun, toy_shards, count=None)
    assert said[0][said[0].index("-n") + 1] == "12"


def test_a_run_of_other_settings_is_named_and_left_as_it_is(begun, toy_shards, calls):
    (begun / "tiny.yaml").write_text(
        (begun / "tiny.yaml").read_text().replace("epochs: 1\n", "epochs: 2\n", 1)
    )
    comparison = load_comparison(str(begun / "compare.yaml"))
    done = compare(comparison, part_of(comparison, "ours", None, None), begun / "out", SOFTWARE)
    assert done.table is None and calls.names == []
    assert done.failures == [
        f"toy, ours, seed 0: {begun}/out/toy/ours/seed0 holds a run with other settings "
        "than those of the comparison; delete it to train again, or name another --out."
    ]


def test_where_rooms_are_drawn_from_by_default_is_no_other_training(begun, toy_shards, calls):
    config = begun / "tiny.yaml"
    config.write_text(config.read_text() + "sampling: {distribution: kernel}\n")
    assert again(begun, toy_shards).failures == [] and calls.names == []


def test_a_truncated_file_is_a_sentence(begun, toy_shards, calls):
    folder = begun / "out" / "toy" / "ours" / "seed0"
    (folder / "scores.json").write_bytes((folder / "scores.json").read_bytes()[:40])
    with pytest.raises(InputError, match=r"seed0/scores\.json is damaged; delete it and run"):
        again(begun, toy_shards)
    (folder / "steps.json").write_bytes((folder / "steps.json").read_bytes()[:40])
    (failure,) = again(begun, toy_shards).failures
    assert "seed0/steps.json is damaged; delete it and run the same command" in failure


def test_a_stopped_comparison_says_how_it_goes_on(command, written, calls, tmp_path):
    def stop(arguments):
        raise KeyboardInterrupt

    calls.before = stop
    status, _, errors = command("compare", "--config", written(), "--out", tmp_path / "out")
    assert status == 130 and errors.endswith("Stopped. Run the same command again to continue.\n")
    assert not (tmp_path / "out" / "table.md").exists()


def test_a_folder_that_is_a_file_is_a_sentence(begun):
    (begun / "file").touch()
    comparison = load_comparison(str(begun / "compare.yaml"))
    with pytest.raises(InputError, match="file cannot be written"):
        compare(comparison, comparison, begun / "file", SOFTWARE)


def test_methods_without_latents_of_rooms_are_evaluated_once_by_their_own(written, tmp_path):
    own = tmp_path / "atiss.yaml"
    own.write_text(yaml.safe_dump(tiny_baseline_settings(Path("elsewhere"), "atiss")))
    atiss = {"title": "ATISS", "config": str(own)}
    comparison = load_comparison(
        written(
            methods={"ours": METHODS["ours"], "atiss": atiss}, distributions=["paper", "kernel"]
        )
    )
    ours, other = (
        scoring_steps(comparison, run, 4, SOFTWARE) for run in runs_of(comparison, Path())
    )
    assert [step.name for step in ours] == ["scores", "scores_kernel"]
    assert [step.arguments[-1] for step in ours] == ["paper", "kernel"]
    (step,) = other
    assert step.name == "scores" and "--distribution" not in step.arguments
    with pytest.raises(InputError, match="distributions"):
        load_comparison(written(distributions=["anywhere"]))


def test_the_large_comparison_loads_and_says_where_rooms_come_from():
    comparison = load_comparison("compare/new_rooms.yaml")
    origins = {
        run.method: [variant.name for variant in variants_of(comparison, run)]
        for run in runs_of(comparison, Path())
    }
    assert origins["lifted"] == [None, "paper", "kernel"]
    assert origins["lstm"] == origins["c1"] == ["paper", "kernel"]
    assert origins["atiss"] == [None]


def test_scenes_that_are_there_are_a_row_beside_ours(begun, toy_shards, scenes, monkeypatch):
    monkeypatch.setattr(StepRunner, "call", call_here)
    scenes = shutil.copytree(scenes, begun / "given", ignore=shutil.ignore_patterns("scores.json"))
    given = {"title": "Theirs", "scenes": {"toy": str(scenes)}}
    methods = {"ours": {}, "theirs": given}
    done = again(begun, toy_shards, "theirs", methods=methods)
    assert done.failures == [] and done.left_out == []
    folder = begun / "out" / "toy" / "theirs"
    words = json.loads((folder / "steps.json").read_text())["scores"]["arguments"]
    assert " ".join(words).startswith(f"eval-fid --scenes {scenes} --shards {toy_shards} --out")
    assert not (folder / "run").exists() and not (scenes / "scores.json").exists()
    table = (begun / "out" / "table.md").read_text()
    assert "of scenes as given, which were made elsewhere: 'Theirs'." in table
    heads = [line.strip("| ") for line in table.splitlines() if line.startswith("| *")]
    assert heads == [
        "*reference*", "*rooms of new latents (paper)*", "*scenes as given, made elsewhere*",
        "*training rooms, decoded: nothing is new*", "*copies: rooms near training rooms*",
    ]  # fmt: skip
    (line,) = (line for line in table.splitlines() if line.startswith("| Theirs "))
    assert line.split(" | ")[1] == "as given" and line.endswith("| – | – | – |")
    assert line.split(" | ")[2:] != ["–"] * len(line.split(" | ")[2:])


def test_scenes_are_evaluated_again_when_they_change_and_need_as_many_as_others(
    begun, toy_shards, scenes, calls
):
    scenes = shutil.copytree(scenes, begun / "given")
    methods = {"ours": {}, "theirs": {"title": "Theirs", "scenes": {"toy": str(scenes)}}}

    def states() -> str:
        comparison = load_comparison(write_comparison(begun, toy_shards, methods=methods))
        run = next(run for run in runs_of(comparison, begun / "out") if run.scenes is not None)
        assert (run.seed, run.title) == (None, "toy, theirs") and costs_of(run) == {}
        (step,) = scoring_steps(comparison, run, 4, SOFTWARE)
        return step.depends_on[-1]

    before = states()
    assert states() == before
    (scenes / "room_0.json").write_text((scenes / "room_1.json").read_text() + " ")
    assert states() != before
    calls.status = 2
    done = again(begun, toy_shards, "theirs", methods=methods)
    assert done.failures == ["toy, theirs: no room for more."] and calls.names == ["eval-fid"]
