"""eval-fid from the command line: a run, the user's scenes, refusals."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from sceneprior.apps.api import load
from sceneprior.apps.experiments import evaluate
from sceneprior.apps.experiments.evaluate import evaluate_run, mask_scores
from sceneprior.apps.rooms import write_scenes
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import InputError
from sceneprior.core.scene import SceneObject
from sceneprior.core.shards import iterate_rooms
from sceneprior.evaluation.metrics.contents import class_counts
from sceneprior.evaluation.synthesis import EvalOptions
from sceneprior.evaluation.use import UseOptions
from sceneprior.paper.sampling import COPIES


def test_the_users_scenes_are_evaluated_and_have_a_page(command, scenes, toy_shards, tmp_path):
    folder = shutil.copytree(scenes, tmp_path / "mine", ignore=shutil.ignore_patterns("scores*"))
    (folder / "cameras.json").write_text("[1, 2]")
    (folder / "room_9.json").write_text('{"objects": []}')
    given = ["--scenes", folder, "--shards", toy_shards]
    status, out, errors = command("eval-fid", *given, "--resamples", 20)
    assert status == 0, errors
    assert f"Wrote {folder / 'scores.json'}" in out.replace("\n", "") and "4 rooms" in out
    (said,) = (line for line in errors.splitlines() if "Warning: " in line)
    assert said.endswith(
        f"4 scenes are read from {folder}; 2 other JSON files there are not scenes ('format' is "
        "not sceneprior-scene) and are skipped: cameras.json, room_9.json."
    )
    scores = json.loads((folder / "scores.json").read_text())
    assert scores["protocol"]["scenes"] == "mine" and scores["protocol"]["resamples"] == 20
    assert scores["near_copy_share"] == 1 and scores["out_of_bounds_share"] == 0
    status, out, errors = command("report", *given, "--out", "page.html")
    assert (status, out) == (0, "Wrote page.html\n"), errors
    page = (tmp_path / "page.html").read_text()
    assert re.findall("<h2>(.*)</h2>", page) == ["New rooms beside real ones", "Scores"]
    assert "scenes mine" in page and "scenes as given, which were made elsewhere" in page
    assert page.count("<h3>Generated</h3>") == 1
    # scores.json lies among the scenes now, and is none.
    call = ["eval-fid", *given, "-n", 2, "--seed", 3, "--resamples", 0, "--out", "c.json"]
    assert command(*call)[0] == 0
    protocol = json.loads((tmp_path / "c.json").read_text())["protocol"]
    assert (protocol["n_generated"], protocol["n_scenes_available"]) == (2, 4)


def test_a_run_whose_rooms_are_copies_is_warned_of_wherever_it_draws(command, toy_run, tmp_path):
    shutil.copytree(toy_run, tmp_path / "run")
    config = tmp_path / "run" / "config.yaml"
    config.write_text(config.read_text().replace("distribution: paper", "distribution: kernel"))
    soft = ["--run", "run"]
    evaluated = ["eval-fid", *soft, "-n", 3, "--resamples", 0]
    status, _, errors = command(*evaluated)
    assert status == 0 and errors.count(COPIES) == 1
    status, _, errors = command("report", *soft)
    assert status == 0 and errors.count(COPIES) == 1
    page = (tmp_path / "run" / "report.html").read_text()
    assert "learns from masks in 2D; rooms drawn by: kernel, copies: near training rooms" in page


def test_a_run_without_3d_truth_has_a_page_and_scores_from_views(
    command, toy_shards, bare, toy_run, tmp_path
):
    shutil.copytree(toy_run, tmp_path / "run")
    config = tmp_path / "run" / "config.yaml"
    config.write_text(config.read_text().replace(str(toy_shards), str(bare)))
    status, _, errors = command("report", "--run", "run")
    assert status == 0, errors
    page = (tmp_path / "run" / "report.html").read_text()
    assert (
        "<h2>New rooms</h2>" in page and "The test rooms of these shards have no 3D boxes" in page
    )
    assert "<h2>Training input</h2>" in page and "Real, test split" not in page
    assert "<h2>Scores</h2>" not in page and "<h2>Decoded training rooms<" not in page
    status, printed, errors = command("eval-fid", "--run", "run", "-n", 3, "--seed", 1)
    assert status == 0, errors
    assert "Not measured without rooms in 3D" in printed and "Category KL" in printed
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())
    tracked = [s.read_room(r).object_class for s, r in iterate_rooms(toy_shards, "test")]
    assert scores["mean_objects_test"] == np.mean([len(labels) for labels in tracked])
    seen = np.bincount(np.concatenate(tracked), minlength=22) / sum(map(len, tracked))
    made = sample_rooms(load(tmp_path / "run").with_latents, 3, 1)
    counts = class_counts(made).sum(0)
    logs = (np.log(share + 1e-6) for share in (seen, counts / counts.sum()))
    assert scores["category_kl"] == pytest.approx((seen * np.subtract(*logs)).sum())
    assert scores["mean_objects"] == np.mean([len(scene.objects) for scene in made])
    assert scores["type_share_test"] == 1 and scores["train_rooms"]["category_kl"] >= 0
    low, high = scores["intervals"]["generated"]["mean_objects"]
    assert low <= scores["mean_objects"] <= high
    assert 0 < scores["mask_iou_training_views"] < 1
    assert scores["protocol"]["n_test"] == 4 and "known from views alone" in scores["note"]
    # Scenes of any method have scores from views, too.
    write_scenes(made, tmp_path / "made")
    call = ["eval-fid", "--scenes", "made", "--shards", "bare", "--resamples", 0]
    assert command(*call)[0] == 0
    again = json.loads((tmp_path / "made" / "scores.json").read_text())
    assert again["category_kl"] == pytest.approx(scores["category_kl"])
    assert again["intervals"]["generated"]["mean_objects"] is None


def test_a_request_stands_in_the_protocol(toy_run, monkeypatch):
    monkeypatch.setattr(evaluate, "scores_of", lambda *given: {"protocol": {}})
    for asked in ({"floor": "4x3", "want": "a desk"}, None):
        scores = evaluate_run(toy_run, 2, EvalOptions(), use=UseOptions(), asked=asked)
        assert scores["protocol"].get("request") == asked
    given = {"objects": (SceneObject("desk", (0.0, 0.4, 0.0), (1.0, 0.8, 0.6)),)}
    scores = evaluate_run(toy_run, 2, EvalOptions(), use=UseOptions(), asked=given)
    assert "desk" in json.dumps(scores)


def test_views_that_training_never_saw_are_held_out(toy_shards, toy_run):
    trained = load(toy_run).with_latents
    assert set(mask_scores(trained, toy_shards)) == {"mask_iou_training_views"}
    data = trained.config.data.model_copy(update={"view_fraction": 0.5})
    half = replace(trained, config=trained.config.model_copy(update={"data": data}))
    (found,) = mask_scores(half, toy_shards).items()
    assert found[0] == "mask_iou_held_out" and 0 < found[1] < 1
    with pytest.raises(InputError, match="does not hold the training rooms of this run"):
        mask_scores(replace(trained, room_ids=("elsewhere",)), toy_shards)
