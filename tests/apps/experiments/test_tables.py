"""Commands and tables of comparisons are as before, from result files that are made up."""

from pathlib import Path

import pytest
from golden_values import TAKE
from made_results import METHODS, write_comparison, write_new_rooms, write_views

from sceneprior.apps.experiments import comparison as module
from sceneprior.apps.experiments import table
from sceneprior.apps.experiments.compare import commands_of, part_of
from sceneprior.apps.experiments.comparison import (
    load_comparison,
    runs_of,
    shards_of,
    variants_of,
)
from sceneprior.apps.experiments.table import write_tables

GOLDEN = Path(__file__).parents[2] / "golden" / "apps"


def test_shipped_comparisons_run_the_same_commands_for_the_same_rows(monkeypatch):
    monkeypatch.setattr(module, "iterate_rooms", lambda *given: range(149))
    monkeypatch.setattr(module, "known_in_3d", lambda *given: True)
    lines = []
    for name, rooms in (
        ("new_rooms", None),
        ("paper", "bedroom,living_small"),
        ("tuned", "bedroom"),
        ("single_view", None),
    ):
        comparison = load_comparison(f"compare/{name}.yaml")
        lines.append(f"# {name}")
        for run in part_of(comparison, Path("out"), rooms=rooms, seeds="0"):
            shards = shards_of(comparison, run.rooms)
            shared = comparison.shared_options(shards, Path("inception.pt"))
            rows = {
                variant.result.stem: f"{variant.title} | {variant.made_by}"
                for variant in variants_of(comparison, run)
            }
            lines.append(run.title)
            for each in commands_of(comparison, run, shared, "cpu"):
                lines.append(f"  {each.name}: {' '.join(each.arguments)} -> {each.result}")
                if each.name in rows:
                    needs = " ".join(each.depends_on)
                    lines.append(f"    row: {rows[each.name]} | depends on: {needs}")
    found = "\n".join(lines) + "\n"
    if TAKE:
        (GOLDEN / "compare_commands.txt").write_text(found)
    assert found == (GOLDEN / "compare_commands.txt").read_text()


@pytest.fixture(autouse=True)
def costs(monkeypatch):
    """Costs of training without checkpoints; those of the GAN are unknown."""

    def costs_of(run):
        cpu_s = None if run.method == "gan" else 300 + 60.5 * run.seed
        return {"cpu_s": cpu_s, "steps": 4500, "parameters": 1_250_000}

    monkeypatch.setattr(table, "costs_of", costs_of)


def assert_tables(name: str, folder: Path) -> None:
    for ending in ("md", "csv"):
        found = (folder / f"table.{ending}").read_text()
        if TAKE:
            (GOLDEN / f"compare_{name}.{ending}").write_text(found)
        assert found == (GOLDEN / f"compare_{name}.{ending}").read_text()


LATENTS = {None: "sampler", "paper": "paper", "kernel": "kernel, copies: near training rooms"}


def test_tables_of_new_rooms(tmp_path):
    config = str(tmp_path / "tiny.yaml")
    kinds = {
        "toy": {"title": "Toys", "config": config},
        "more": {"title": "More toys", "config": config},
    }
    methods = METHODS | {
        "lifted": {"config": str(tmp_path / "lifted.yaml")},
        "gan": {"title": "GAN", "config": str(tmp_path / "gan.yaml")},
    }
    path = write_comparison(tmp_path, Path("shards"), seeds=[0, 1], rooms=kinds, methods=methods)
    comparison = load_comparison(path)
    runs = runs_of(comparison, tmp_path / "out")
    for number, run in enumerate(runs, start=1):
        for k, variant in enumerate(variants_of(comparison, run)):
            latents = "its own" if run.method == "gan" else LATENTS[variant.name]
            remembers = run.method in ("paper", "lstm")
            write_new_rooms(variant.result, 10 * number + k, latents, remembers)
    write_tables(comparison, runs, tmp_path)
    assert_tables("new_rooms", tmp_path)


def test_tables_of_single_views(tmp_path):
    own = ["sampler=null", "sampling.distribution=paper"]
    methods = {
        "usl": {"title": "USL", "config": str(tmp_path / "usl.yaml")},
        "paper": {},
        "lifted": {"config": str(tmp_path / "lifted.yaml"), "set": {"every": own}},
    }
    path = write_comparison(
        tmp_path, Path("shards"), task="single_views", fits=["paper", "objects"], methods=methods
    )
    comparison = load_comparison(path)
    runs = runs_of(comparison, tmp_path / "out")
    for number, run in enumerate(runs):
        for k, variant in enumerate(variants_of(comparison, run)):
            write_views(variant.result, number + k, run.method == "usl")
    write_tables(comparison, runs, tmp_path)
    assert_tables("views", tmp_path)
