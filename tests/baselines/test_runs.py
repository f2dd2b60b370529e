"""Runs of all baselines: they train, stop, resume, generate, and are evaluated and reported."""

import pytest
import torch
from interrupting import CPU, interrupted
from toy_metrics import without_classifiers

from sceneprior.apps.config import load_any_run
from sceneprior.apps.experiments.evaluate import evaluate_run
from sceneprior.apps.experiments.report import report_run
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.files import write_json
from sceneprior.evaluation.metrics.contents import without_void
from sceneprior.evaluation.synthesis import EvalOptions
from sceneprior.training.fit import fit
from sceneprior.training.method import read_checkpoint

METHODS = ("atiss2d", "gan", "atiss", "sync2gen", "set_flow", "usl", "total3d", "im3d")
STAGES = {name: (name,) for name in METHODS} | {"atiss2d": ("layout", "shape")}


@pytest.fixture(autouse=True)
def no_classifier(monkeypatch: pytest.MonkeyPatch) -> None:
    without_classifiers(monkeypatch)


@pytest.mark.parametrize("method", METHODS)
def test_an_interrupted_and_resumed_run_reaches_the_same_weights(
    baseline_config, baseline_run, method, tmp_path
):
    config, run, last = baseline_config(method), tmp_path / "run", STAGES[method][-1]
    interrupted(config, run, last, 1)
    assert read_checkpoint(run / last / "last.ckpt")["epoch"] == 0
    fit(config, run, resume=True, trainer_options=CPU)
    wanted, reached = (
        read_checkpoint(folder / last / "final.ckpt") for folder in (baseline_run(method), run)
    )
    assert wanted["state_dict"].keys() == reached["state_dict"].keys()
    for key, value in wanted["state_dict"].items():
        assert torch.equal(reached["state_dict"][key], value), key
    assert len(wanted["optimizer_states"]) == (2 if method == "gan" else 1)
    for one, other in zip(wanted["optimizer_states"], reached["optimizer_states"], strict=True):
        for key, moments in one["state"].items():
            assert torch.equal(moments["exp_avg_sq"], other["state"][key]["exp_avg_sq"])


@pytest.mark.parametrize("method", ("gan", "atiss"))
def test_a_run_is_evaluated_and_reported_by_its_new_rooms_alone(baseline_run, method, tmp_path):
    run, options = baseline_run(method), EvalOptions(resamples=5)
    scores = evaluate_run(run, 4, options)
    write_json(tmp_path / "scores.json", scores)
    assert scores["protocol"]["stage"] == method
    assert scores["protocol"]["latents"] == ("paper" if method == "gan" else "its own")
    rooms = [without_void(room) for room in sample_rooms(load_any_run(run), 4, 0)]
    assert "box_iou_3d" not in scores
    assert scores["mean_objects"] == sum(len(room.objects) for room in rooms) / 4
    report_run(run, tmp_path / "scores.json", tmp_path / "page.html", 0)
    page = (tmp_path / "page.html").read_text()
    assert "New rooms beside real ones" in page and "Interpolation on the sphere" not in page
    if method != "gan":
        assert "prior learnt from true boxes in 3D" in page
        assert f"the method {method}, which learns from true boxes in 3D" in page
        assert "Training input" not in page and "latent sphere" not in page
