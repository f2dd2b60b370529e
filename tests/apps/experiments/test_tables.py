"""Commands and tables of comparisons are as before, from result files that are made up."""

import json
from pathlib import Path
from typing import Any

import pytest
from golden_values import TAKE
from made_results import METHODS, write_comparison, write_new_rooms, write_views

from sceneprior.apps.experiments import comparison as module
from sceneprior.apps.experiments import rows as rows_module
from sceneprior.apps.experiments.compare import commands_of, part_of
from sceneprior.apps.experiments.comparison import (
    load_comparison,
    runs_of,
    shards_of,
    variants_of,
)
from sceneprior.apps.experiments.rows import NEW_ROOMS, UNRANKED, Row, form_of, rows_of
from sceneprior.apps.experiments.sources import compare_sources
from sceneprior.apps.experiments.table import table_of, write_tables
from sceneprior.core.files import write_json
from sceneprior.evaluation.synthesis import EvalOptions

PROTOCOL = {"n_generated": 4, "n_test": 3, "n_train_rooms": 12, "shards": "front"}
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

    monkeypatch.setattr(rows_module, "costs_of", costs_of)


def assert_tables(name: str, folder: Path) -> None:
    for ending in ("md", "csv"):
        found = (folder / f"table.{ending}").read_text()
        if TAKE:
            (GOLDEN / f"compare_{name}.{ending}").write_text(found)
        assert found == (GOLDEN / f"compare_{name}.{ending}").read_text()


def made(title: str, interval: list[float], key: str = "fd_effnet_lite0", **changes: Any) -> Row:
    """A row with one value, the middle of its interval."""
    scores = {key: sum(interval) / 2, "intervals": {key: interval}, "protocol": PROTOCOL, **changes}
    return Row("Toys", 0, title, "", "as given", scores, "new rooms", 0)


@pytest.mark.parametrize(
    ("key", "intervals", "marks"),
    [
        ("fd_effnet_lite0", ([1, 2], [3, 4], [3, 9]), ["best", "", ""]),
        ("fd_effnet_lite0", ([1, 3], [2, 9], [4, 5]), ["tied", "tied", ""]),
        ("rooms_without_fault", ([0.1, 0.2], [0.3, 0.4], [0.5, 0.6]), ["", "", "best"]),
        ("sca_effnet_lite0", ([0.3, 0.4], [0.45, 0.52], [0.9, 0.95]), ["", "best", ""]),
        ("mean_objects", ([1, 2], [3, 4], [5, 6]), ["", "", ""]),
    ],
)
def test_best_is_what_no_interval_of_another_row_overlaps(key, intervals, marks):
    rows = [made(f"m{k}", each, key) for k, each in enumerate(intervals)]
    copies = made("copies", [0.49, 0.5], key)._replace(group=UNRANKED[-1], rank=1)
    table = table_of([*rows, copies], NEW_ROOMS)
    assert [line.cells[0].mark for line in table.lines] == [*marks, ""]


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("n_test", 7, "test rooms 7 in place of 3"),
        ("request", {"floor": "4x3"}, "requested rooms {'floor': '4x3'} in place of None"),
    ],
)
def test_results_of_another_protocol_are_set_apart_and_undefined_values_are_dashes(
    tmp_path, key, value, said
):
    written = {}
    for number, name in enumerate(("one", "two", "other")):
        path = tmp_path / name / "scores.json"
        write_new_rooms(path, number, "its own", remembers=False)
        written[name] = path
    odd = json.loads(written["other"].read_text())
    odd["protocol"][key], odd["note"] = value, "4 of 4 generated rooms are empty: train longer."
    write_json(written["other"], odd)
    paths = [str(path) for path in written.values()]
    assert compare_sources(paths, None, tmp_path, None, EvalOptions()) == 2
    near, far = (tmp_path / "table.md").read_text().split("### ")[1:]
    assert "| one |" in near and "| two |" in near and "| other |" not in near
    assert f"{said}.\n" in far
    cells = next(line for line in far.splitlines() if line.startswith("| other |")).split(" | ")
    assert sorted({cell.strip("| ") for cell in cells[2:]}) == ["22.49 [20.24, 24.74]", "–"]


def test_the_page_sorts_and_nothing_is_cut_off(browser, tmp_path):
    """Best first, undefined values last; a second click reverses; phones scroll the table only."""
    rows = [made(name, [k, k + 2.0]) for name, k in (("b", 5), ("c", 9), ("a", 1))]
    rows.append(made("undefined", [0, 0], fd_effnet_lite0=None))
    write_tables(rows, NEW_ROOMS, tmp_path)
    browser.get((tmp_path / "table.html").as_uri())
    heads = "document.querySelectorAll('.scores tbody th[scope]')"
    first = f"return [...{heads}].map(head => head.firstChild.data)"
    assert browser.execute_script(first) == ["b", "c", "a", "undefined"]
    for order in (["a", "b", "c", "undefined"], ["c", "b", "a", "undefined"]):
        browser.find_element("css selector", ".scores button").click()
        assert browser.execute_script(first) == order
    phone = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", phone)
    try:
        assert browser.execute_script("return document.documentElement.scrollWidth") == 390
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


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
    rows = [row for run in runs for row in rows_of(comparison, run)]
    write_tables(rows, form_of(comparison), tmp_path)
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
    rows = [row for run in runs for row in rows_of(comparison, run)]
    write_tables(rows, form_of(comparison), tmp_path)
    assert_tables("views", tmp_path)
