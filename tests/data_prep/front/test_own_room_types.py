"""docs/own_room_types.md runs as printed, on kitchens in 3D-FRONT's format made here."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml
from front_files import FrontFolder, room
from front_jobs import rooms_of
from pages import ROOT, first_block, run_first_commands
from toy_metrics import without_classifiers

from data_prep.engine.build import Job, build_shards
from data_prep.engine.report import report_tables
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from sceneprior.apps.retrieval.cad_models import open_models
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.shards import read_index

PAGE = ROOT / "docs" / "own_room_types.md"
LABEL_SET = "void,cabinet,fridge,sink,stool,stove,table"
MODELS = {
    "cold": ("Refrigerator / Freezer", (0.7, 1.9, 0.7)),
    "hob": ("Gas Stove", (0.6, 0.9, 0.6)),
    "basin": ("Sink", (0.8, 0.9, 0.6)),
    "unit": ("Base Cabinet", (1.2, 0.9, 0.6)),
    "board": ("Dining Table", (1.4, 0.75, 0.8)),
    "perch": ("Barstool", (0.4, 0.7, 0.4)),
    "plant": ("Potted Plant", (0.3, 0.8, 0.3)),
}


def write_kitchens(folder: Path, houses: int = 8) -> FrontFolder:
    """Two kitchens a house, and a bedroom that is of another recipe."""
    front = FrontFolder(folder)
    for jid, (category, size) in MODELS.items():
        front.model(jid, category, size)
    rng = np.random.default_rng(0)
    for number in range(houses):
        rooms = [room("Bedroom-0", [{"jid": "unit", "pos": (0.0, 0.0, 0.0)}])]
        for k in range(2):
            pieces = [
                {"jid": jid, "pos": (x + rng.uniform(-0.05, 0.05), 0.0, -1.6)}
                for jid, x in zip(
                    ["cold", "hob", "basin", "unit"], rng.permutation(4) - 1.5, strict=True
                )
            ]
            x, z = rng.uniform(-0.4, 0.4), rng.uniform(0.2, 1.0)
            pieces.append({"jid": "board", "pos": (x, 0.0, z)})
            pieces += [
                {"jid": "perch", "pos": (x + side, 0.0, z), "yaw": np.pi / 2}
                for side in (-1.0, 1.0)[: rng.integers(1, 3)]
            ]
            pieces.append({"jid": "plant", "pos": (1.8, 0.0, 1.7)})
            rooms.append(room(f"Kitchen-{k}", pieces, kind="Kitchen", bounds=(-2.1, -2, 2.1, 2)))
        front.house(f"house{number}", *rooms)
    return front


def kitchen_job(front: FrontFolder, out: Path, **changes: object) -> Job:
    path = out.with_suffix(".yaml")
    path.write_text(yaml.safe_dump({**yaml.safe_load(first_block(PAGE, "yaml")), **changes}))
    rules = ("views.image_size=[90, 120]", "views.per_m2=0.5", "views.min_object_pixels=20")
    recipe = load_recipe(str(path), rules)
    return Job(FrontSource(front.front, front.future, recipe), out, renderer="software")


def test_categories_and_models_get_the_classes_of_the_users_recipe(tmp_path):
    front = write_kitchens(tmp_path, houses=2)
    summary = build_shards(kitchen_job(front, tmp_path / "mine"))
    index = read_index(tmp_path / "mine")
    assert (index["label_set"], index["room_type"]) == (LABEL_SET, "mine")
    names = label_set(LABEL_SET)
    for _, truth in rooms_of(tmp_path / "mine").values():
        classes = {names[c]: m for c, m in zip(truth.object_class, truth.model_ids, strict=True)}
        assert classes == {
            "fridge": "cold", "stove": "hob", "sink": "basin", "cabinet": "unit",
            "table": "board", "stool": "perch",
        }  # fmt: skip
    # The plant is void because nobody said what it is; the stool is the paper's.
    assert summary.report["unknown_categories"] == {"potted plant": 4}
    assert "unknown_categories" in json.loads((tmp_path / "mine" / "report.json").read_text())
    assert "category without a class" in [
        table.columns[0].header for table in report_tables(summary.report)
    ]
    said = {"potted plant": "void"}
    quiet = build_shards(kitchen_job(front, tmp_path / "quiet", categories=said, min_objects=1))
    assert set(quiet.report["unknown_categories"]) == {
        "refrigerator/freezer", "gas stove", "base cabinet",
    }  # fmt: skip
    models = open_models(tmp_path / "mine", LABEL_SET, tmp_path / "cache")
    found = {label: models.of_class(label) for label in label_set(LABEL_SET)}
    assert {label: some.model_ids for label, some in found.items() if some} == {
        "cabinet": ("unit",), "fridge": ("cold",), "sink": ("basin",), "stool": ("perch",),
        "stove": ("hob",), "table": ("board",),
    }  # fmt: skip
    np.testing.assert_allclose(np.ptp(models.load("cold").vertices_m, axis=0), 1)
    with pytest.raises(
        InputError, match=f"have label set '{LABEL_SET}', but the scenes have 'scannet'"
    ):
        open_models(tmp_path / "mine", "scannet", tmp_path / "cache")
    shutil.copytree(tmp_path / "mine", tmp_path / "spoilt")
    (tmp_path / "spoilt" / "models" / "hob.ply").write_bytes(b"ply")
    damaged = open_models(tmp_path / "spoilt", LABEL_SET, tmp_path / "cache")
    assert "is not a triangle mesh" in damaged.broken["hob"]


def test_a_recipe_whose_categories_do_not_fit_says_which_there_are(tmp_path):
    front = write_kitchens(tmp_path, houses=1)
    job = kitchen_job(front, tmp_path / "mine", label_set=["oven", "hood"], categories={})
    with pytest.raises(InputError, match=r"0 objects, min_objects is 3 \(of no class: .*gas stove"):
        build_shards(job)


@pytest.mark.slow
def test_the_page_runs_as_printed(tmp_path, monkeypatch):
    without_classifiers(monkeypatch)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    write_kitchens(tmp_path / "kitchens")
    Path("kitchens.yaml").write_text(first_block(PAGE, "yaml"))
    assert any("potted plant" in said for said in run_first_commands(PAGE))
    assert f"label_set: {LABEL_SET}" in Path("run/config.yaml").read_text()
    scene = json.loads(next(Path("furnished").glob("*.json")).read_text())
    assert scene["label_set"] == LABEL_SET
    scores = json.loads(Path("run/scores.json").read_text())
    assert scores["protocol"]["label_set"] == LABEL_SET
    assert "<h2>Scores</h2>" in Path("run/report.html").read_text()
