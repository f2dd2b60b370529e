"""Validation: what it computes, on which rooms and views, and that training does not notice it."""

import csv
import math
import shutil
import time
from pathlib import Path

import pytest
import torch
from interrupting import CPU, interrupted
from lightning.pytorch.callbacks import Callback
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny_runs import tiny_baseline, tiny_config

from sceneprior.core.errors import InputWarning
from sceneprior.paper.stages import LatentStage
from sceneprior.training import callbacks, validation
from sceneprior.training.fit import fit
from sceneprior.training.method import read_checkpoint


@pytest.fixture(scope="module")
def val_shards(toy_shards, tmp_path_factory) -> Path:
    """The toy rooms, with a val split."""
    shards = shutil.copytree(toy_shards, tmp_path_factory.mktemp("val") / "shards")
    shutil.copytree(shards / "test", shards / "val")
    return shards


@pytest.fixture
def often(monkeypatch):
    """Latents of val rooms are fitted in every validation, in two steps."""
    monkeypatch.setattr(validation, "STEPS_BETWEEN", 1)
    monkeypatch.setattr(validation, "FIT_STEPS", 2)


def curve(run: Path, stage: str, name: str) -> list[float]:
    with (run / stage / "metrics.csv").open(newline="") as file:
        return [float(row[name]) for row in csv.DictReader(file) if row.get(name)]


def pictures(run: Path, stage: str) -> dict[str, list[int]]:
    """Steps of the pictures in TensorBoard's file."""
    events = EventAccumulator(str(run / stage)).Reload()
    return {tag: [image.step for image in events.Images(tag)] for tag in events.Tags()["images"]}


class Cameras(Callback):
    """The cameras of all batches of training and validation, and the rows of the latter."""

    def __init__(self):
        self.train, self.val, self.rows = set(), set(), []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.train |= {tuple(c) for c in batch.world_to_camera.flatten(0, 1).flatten(1).tolist()}

    def on_validation_batch_start(self, trainer, pl_module, batch, batch_idx, dataloader_idx=0):
        if dataloader_idx == 0:
            self.val |= {tuple(c) for c in batch.world_to_camera.flatten(0, 1).flatten(1).tolist()}
            self.rows += batch.room_index.tolist()


def test_training_does_not_notice_its_validation(val_shards, tmp_path, often, monkeypatch):
    """Every weight has the same bits without, and without pictures, with dropout and steps of the
    latents."""
    runs = {}
    monkeypatch.setattr(callbacks, "DRAWING", math.inf)
    for every in (0, 1):
        given = {f"{stage}__val_every": every for stage in ("layout", "shape")}
        given |= {"model__decoder__dropout": 0.2, "layout__latent_noise": 0.1}
        config = tiny_config(val_shards, layout__epochs=4, data__view_fraction=0.5, **given)
        runs[every] = tmp_path / str(every)
        seen = Cameras()
        fit(config, runs[every], False, ("csv", "tensorboard"), CPU, [seen])
        assert seen.val.isdisjoint(seen.train)
        assert seen.rows == list(range(12)) * 7 * every
    for stage, epochs in (("layout", 4), ("shape", 3)):
        without, with_ = (
            read_checkpoint(runs[every] / stage / "final.ckpt")["state_dict"] for every in (0, 1)
        )
        assert all(without[name].equal(with_[name]) for name in without)
        for group in ("val", "val_rooms"):
            for name in ("class", "box", "completeness", "loss"):
                assert len(curve(runs[1], stage, f"{group}/{name}")) == epochs
        assert not curve(runs[0], stage, "val/loss") and not pictures(runs[0], stage)
        steps = [(3 if stage == "layout" else 2) * epoch for epoch in range(1, epochs + 1)]
        assert pictures(runs[1], stage) == {"rooms/decoded": steps, "rooms/drawn": steps}
        assert len(curve(runs[1], stage, "train/gradient_norm")) == epochs
        assert len(curve(runs[1], stage, "train/latents_std")) == epochs
    assert curve(runs[1], "layout", "lr/2") == pytest.approx([0.05] * 3 + [0.005])
    assert len(curve(runs[1], "shape", "val_rooms/mask_iou")) == 3


def test_fitted_latents_explain_val_rooms(val_shards, tmp_path, often, monkeypatch):
    config = tiny_config(val_shards, layout__epochs=8, layout__val_every=8, shape__epochs=1)
    losses = []
    for steps in (0, 30):
        monkeypatch.setattr(validation, "FIT_STEPS", steps)
        run = tmp_path / str(steps)
        fit(config, run, False, ("csv",), CPU)
        losses += curve(run, "layout", "val_rooms/loss")
    assert losses[1] < losses[0]


class Spoil(Callback):
    """Removes the network's weights from the fourth epoch on."""

    def on_train_epoch_start(self, trainer, pl_module):
        if trainer.current_epoch >= 3:
            with torch.no_grad():
                for parameter in pl_module.prior.layout.parameters():
                    parameter.fill_(-5)


def test_the_best_epoch_is_kept(toy_shards, tmp_path, monkeypatch):
    """Also if the run is stopped and resumed in between."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    given = {"layout__val_every": 1, "layout__keep": "best"}
    spoil = [{"test_validation.Spoil": None}]
    config = tiny_config(toy_shards, shape__epochs=1, callbacks=spoil, **given)
    run = tmp_path / "run"
    interrupted(config, run, "layout", 4)
    fit(config, run, True, ("csv",), CPU)
    best, last, final = (
        read_checkpoint(run / "layout" / f"{name}.ckpt") for name in ("best", "last", "final")
    )
    losses = curve(run, "layout", "val/loss")
    assert len(losses) == 6 and losses.index(min(losses)) == best["epoch"] == final["epoch"] == 2
    assert last["epoch"] == 5
    assert all(
        torch.equal(final["state_dict"][key], best["state_dict"][key]) for key in best["state_dict"]
    )


@pytest.mark.parametrize("method", ["gan", "atiss", "sync2gen", "set_flow", "total3d"])
def test_baselines_are_validated_on_val_rooms_and_draw_pictures(
    val_shards, tmp_path, method, monkeypatch
):
    monkeypatch.setattr(callbacks, "DRAWING", math.inf)
    config = tiny_baseline(val_shards, method, training__epochs=2, training__val_every=1)
    fit(config, tmp_path / "run", False, ("csv", "tensorboard"), CPU)
    assert len(curve(tmp_path / "run", method, "val/loss")) == (0 if method == "gan" else 2)
    found = {name: len(steps) for name, steps in pictures(tmp_path / "run", method).items()}
    assert found == ({} if method == "total3d" else {"rooms/drawn": 2})


def test_pictures_that_take_too_long_are_drawn_once(toy_shards, tmp_path, monkeypatch):
    drawn = []

    def slow(trained, count):
        drawn.append(trained.stage)
        time.sleep(1)
        return {}

    monkeypatch.setattr(LatentStage, "examples", staticmethod(slow))
    given = {"layout__epochs": 3, "layout__val_every": 1, "shape__epochs": 1}
    fit(tiny_config(toy_shards, **given), tmp_path / "run", False, ("tensorboard",), CPU)
    assert drawn == ["layout", "shape"]


def test_val_rooms_that_do_not_fit_are_named(val_shards, tmp_path):
    shards = shutil.copytree(val_shards, tmp_path / "shards")
    for path in (shards / "val").iterdir():
        path.write_bytes(path.read_bytes()[:1000])
    config = tiny_config(shards, layout__epochs=1, shape__epochs=1)
    with pytest.warns(InputWarning, match="layout is not validated on the val rooms of .* cannot"):
        fit(config, tmp_path / "run", False, (), CPU)
