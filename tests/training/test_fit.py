"""Training on toy rooms: what a run leaves behind, how it stops and goes on, what it may read."""

import csv
import shutil
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from interrupting import CPU, interrupted
from refusals import refused
from tiny_runs import tiny_config, write_tiny_config

from sceneprior.apps.api import load
from sceneprior.apps.config import load_config
from sceneprior.core.files import only_writer
from sceneprior.paper import stages
from sceneprior.training import fit as train
from sceneprior.training.fit import fit
from sceneprior.training.method import find_checkpoint, read_checkpoint


def weights(path: Path) -> dict[str, torch.Tensor]:
    return read_checkpoint(path)["state_dict"]


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


def curve(run: Path, stage: str, name: str = "train/loss") -> list[float]:
    with (run / stage / "metrics.csv").open(newline="") as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


@pytest.fixture(scope="module")
def trained_run(toy_shards, tmp_path_factory) -> Path:
    """The run `toy_run`, trained here."""
    run = tmp_path_factory.mktemp("trained") / "run"
    fit(tiny_config(toy_shards, layout__epochs=20), run, trainer_options=CPU)
    return run


def test_both_stages_learn_and_leave_what_runs_py_promises(trained_run, toy_shards):
    files = {
        str(path.relative_to(trained_run)) for path in trained_run.rglob("*") if path.is_file()
    }
    for stage in ("layout", "shape"):
        assert {f"{stage}/final.ckpt", f"{stage}/metrics.csv"} <= files
        assert any(name.startswith(f"{stage}/events.out.tfevents") for name in files)
    assert "layout/last.ckpt" in files
    assert not [name for name in files if name.endswith(".part")]
    assert load_config(str(trained_run / "config.yaml")) == tiny_config(
        toy_shards, layout__epochs=20
    )
    layout, shape = curve(trained_run, "layout"), curve(trained_run, "shape")
    assert (len(layout), len(shape)) == (20, 3)
    assert layout[-1] < 0.75 * layout[0] and np.isfinite(layout + shape).all()
    for name in ("class", "box", "completeness", "frustum", "mask", "mask_iou", "mask_used"):
        values = curve(trained_run, "shape", f"train/{name}")
        assert len(values) == 3, name
    assert 0 < curve(trained_run, "shape", "train/mask_iou")[-1] < 1


def test_resuming_a_finished_run_trains_nothing(toy_run, toy_shards, tmp_path, monkeypatch):
    run = shutil.copytree(toy_run, tmp_path / "run")
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    monkeypatch.setattr(train, "_train", None)  # calling it would fail
    fit(tiny_config(toy_shards, layout__epochs=20), run, resume=True)
    assert {path: path.read_bytes() for path in run.rglob("*") if path.is_file()} == before


@pytest.mark.parametrize(
    "extra",
    [
        {"model__decoder__dropout": 0.2},
        {"layout__schedule": {"name": "cosine"}, "shape__schedule": {"name": "cosine"}},
    ],
    ids=["dropout", "cosine"],
)
def test_an_interrupted_and_resumed_run_reaches_the_same_weights(toy_shards, tmp_path, extra):
    """Stopped in the layout stage, gone on with, stopped in the shape stage, and finished."""
    config = tiny_config(toy_shards, **extra)
    whole, run = tmp_path / "whole", tmp_path / "stopped"
    fit(config, whole, trainer_options=CPU)
    for stage, epoch, resume in (("layout", 4, False), ("shape", 2, True)):
        interrupted(config, run, stage, epoch, resume)
        assert (run / stage / "last.ckpt").is_file() and not (run / stage / "final.ckpt").exists()
        assert read_checkpoint(run / stage / "last.ckpt")["epoch"] == epoch - 1
    fit(config, run, resume=True, trainer_options=CPU)
    for stage in ("layout", "shape"):
        final = Path(stage, "final.ckpt")
        assert same(weights(whole / final), weights(run / final)), stage
        assert len(curve(run, stage)) == len(curve(whole, stage))


def test_training_never_opens_the_ground_truth(toy_shards, tmp_path):
    """Three epochs with and without the group: every weight has the same bits."""
    blind = shutil.copytree(toy_shards, tmp_path / "blind")
    removed = 0
    for path in blind.rglob("*.h5"):
        with h5py.File(path, "r+") as file:
            for room in file["rooms"].values():
                del room["ground_truth"]
                removed += 1
    assert removed == 16
    results = []
    for shards in (toy_shards, blind):
        run = tmp_path / f"run_of_{shards.name}"
        fit(tiny_config(shards, layout__epochs=3), run, trainer_options=CPU)
        results.append([weights(run / stage / "final.ckpt") for stage in ("layout", "shape")])
    assert same(results[0][0], results[1][0]) and same(results[0][1], results[1][1])
    start = tiny_config(toy_shards).build_latents(12)
    assert not torch.equal(start.weight, results[0][1]["latents.weight"])  # it did train


@pytest.mark.slow
def test_ctrl_c_at_the_command_saves_and_resume_finishes(toy_shards, tmp_path, start):
    config = write_tiny_config(tmp_path / "tiny.yaml", toy_shards, layout__epochs=100000)
    run = tmp_path / "run"
    command = [
        sys.executable, "-m", "sceneprior", "fit", "--config", str(config), "--run", str(run),
        "--accelerator", "cpu",
    ]  # fmt: skip
    process = start(
        command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, cwd=tmp_path
    )
    deadline = time.monotonic() + 400
    while not (run / "layout" / "last.ckpt").is_file():
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=400)
    assert process.returncode == 130
    go_on = f"sceneprior fit --config {run / 'config.yaml'} --run {run} --resume"
    assert f"Stopped and saved. Continue with: {go_on}" in errors
    assert "Traceback" not in errors
    assert not list(run.rglob("*.part")) and not (run / "layout" / "final.ckpt").exists()
    reached = read_checkpoint(run / "layout" / "last.ckpt")["epoch"]
    assert 0 <= reached < 100000
    # Finish from there, with as many epochs as were reached and two more.
    text = (run / "config.yaml").read_text().replace("epochs: 100000", f"epochs: {reached + 2}")
    (run / "config.yaml").write_text(text)
    fit(load_config(str(run / "config.yaml")), run, resume=True, trainer_options=CPU)
    assert find_checkpoint(run, ("layout", "shape")) == ("shape", run / "shape" / "final.ckpt")


def test_a_loss_that_is_no_number_names_its_rooms(toy_shards, tmp_path, monkeypatch):
    """In the step in which it appears."""
    mask_loss, poisoned = stages.mask_loss, []

    def of_masks(masks, views, *args, **settings):
        poisoned.append(views.room_ids)
        loss, overlap = mask_loss(masks, views, *args, **settings)
        return loss * torch.nan, overlap

    monkeypatch.setattr(stages, "mask_loss", of_masks)
    with pytest.raises(FloatingPointError, match="The loss is nan on rooms toy/train_") as error:
        fit(tiny_config(toy_shards), tmp_path / "run", trainer_options=CPU)
    assert len(poisoned) == 1 and all(room in str(error.value) for room in poisoned[0])
    assert str(error.value).count("toy/train_") == 6  # those of the batch
    # After an error, nothing is saved.
    assert not list((tmp_path / "run" / "shape").rglob("*.ckpt"))


def test_settings_and_shards_that_do_not_fit(toy_run, toy_shards, tmp_path):
    config = tiny_config(toy_shards, layout__epochs=20)
    hidden = {"run": toy_run, "shards": toy_shards}
    with refused("training/holds a run", **hidden):
        fit(config, toy_run)
    with refused("training/other settings", **hidden):
        fit(tiny_config(toy_shards, seed=4), toy_run, resume=True)
    with refused("training/other label set", **hidden):
        fit(tiny_config(toy_shards, label_set="scannet"), tmp_path / "a")
    with refused("training/too many objects", **hidden):
        fit(tiny_config(toy_shards, model__max_objects=3), tmp_path / "b")
    with refused("training/no such logger"):
        fit(config, tmp_path / "c", loggers=("paper",))


def test_the_label_set_of_the_shards_is_the_runs(toy_shards, tmp_path):
    config = tiny_config(toy_shards, label_set="shards", layout__epochs=1, shape__epochs=1)
    fit(config, tmp_path / "run", trainer_options=CPU)
    trained = load(tmp_path / "run").with_latents
    assert trained.config.label_set == "front3d_bedroom"
    fit(config, tmp_path / "run", resume=True, trainer_options=CPU)  # no other settings
    with refused("training/no shards", tmp=tmp_path):
        tiny_config(tmp_path / "none", label_set="shards").with_label_set()


def test_damaged_or_foreign_checkpoints(toy_run, tmp_path):
    run = shutil.copytree(toy_run, tmp_path / "run")
    path = run / "shape" / "final.ckpt"
    path.write_bytes(path.read_bytes()[:1000])
    with refused("training/damaged", tmp=tmp_path):
        load(run)
    with refused("training/damaged", tmp=tmp_path):
        fit(load_config(str(run / "config.yaml")), run, resume=True, trainer_options=CPU)
    text = (run / "config.yaml").read_text()
    path.unlink()
    (run / "config.yaml").write_text(text.replace("width: 16", "width: 32"))
    with refused("training/of another config", tmp=tmp_path):
        load(run)
    shutil.rmtree(run / "layout")
    for path in run.rglob("*.ckpt"):
        path.unlink()
    with refused("training/no checkpoint", tmp=tmp_path):
        load(run)
    with refused("training/no run", tmp=tmp_path):
        load(tmp_path)


def test_a_second_training_of_the_same_run_is_refused(toy_shards, tmp_path):
    config, run = tiny_config(toy_shards, layout__epochs=1, shape__epochs=1), tmp_path / "run"
    with only_writer(run):
        for resume in (False, True):
            with refused("training/another run writes", tmp=tmp_path):
                fit(config, run, resume=resume, trainer_options=CPU)
    assert not run.exists()


def _zip_of_a_text(path):
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("notes.txt", "no checkpoint")


def _of_another_network(path):
    saved = read_checkpoint(path)
    saved["state_dict"]["latents.weight"] = torch.zeros(3, 3)
    torch.save(saved, path)


SPOILT = {
    "truncated": lambda path: path.write_bytes(path.read_bytes()[:-3000]),
    "zip": _zip_of_a_text,
    "list": lambda path: torch.save([1, 2], path),
    "weights": lambda path: torch.save({"state_dict": {}}, path),
    "network": _of_another_network,
}


@pytest.mark.parametrize("how", SPOILT)
def test_a_spoilt_checkpoint_is_not_resumed_from(toy_shards, tmp_path, begun_run, how):
    run = shutil.copytree(begun_run, tmp_path / "run")
    SPOILT[how](run / "layout" / "last.ckpt")
    with refused(f"training/resumed {how}", tmp=tmp_path):
        fit(tiny_config(toy_shards, layout__epochs=2), run, resume=True, trainer_options=CPU)


def test_an_intact_checkpoint_is_not_blamed(toy_shards, tmp_path, begun_run, monkeypatch):
    """An error in the first epoch after a resume may have any cause; the checkpoint is kept."""
    run = shutil.copytree(begun_run, tmp_path / "run")

    def killed(*_):
        raise RuntimeError("The disk was unplugged.")

    monkeypatch.setattr("sceneprior.paper.stages.LayoutStage.training_step", killed)
    with refused("training/resumed, then ended", tmp=tmp_path):
        fit(tiny_config(toy_shards, layout__epochs=2), run, resume=True, trainer_options=CPU)
    saved = (run / "layout" / "last.ckpt").read_bytes()
    assert saved == (begun_run / "layout" / "last.ckpt").read_bytes()


@pytest.fixture(scope="module")
def begun_run(toy_shards, tmp_path_factory):
    """Stopped in its first stage, after one epoch."""
    run = tmp_path_factory.mktemp("begun") / "run"
    interrupted(tiny_config(toy_shards, layout__epochs=2), run, "layout", 1)
    return run
