"""Looks at a prior in training: when, what is logged and kept, and that training never notices."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import Logger
from PIL import Image
from tiny_runs import tiny_config
from torch.testing import assert_close

from sceneprior.config import load_run
from sceneprior.errors import InputError
from sceneprior.training import fit as train
from sceneprior.training import monitor as samples
from sceneprior.training.callbacks import StepSeed
from sceneprior.training.checkpoints import read_checkpoint
from sceneprior.training.fit import fit
from sceneprior.training.monitor import EvaluationResult

CPU = {"accelerator": "cpu", "devices": 1}
EPOCHS = 6


class Told:
    """A judge whose scores are told beforehand; it keeps what it was shown."""

    def __init__(self, **scores: list[float]):
        self.scores = scores
        self.seen = []

    def __call__(self, trained):
        look = len(self.seen)
        self.seen.append(trained)
        torch.rand(5)  # whoever judges may draw
        picture = np.full((4, 6, 3), look, np.uint8)
        return EvaluationResult(
            {name: float(told[look]) for name, told in self.scores.items()}, picture, "test"
        )


class Stop(StepSeed):
    """Presses Ctrl-C in the middle of an epoch of the layout stage."""

    epoch = 0

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        super().on_train_batch_start(trainer, pl_module, batch, batch_idx)
        if (trainer.current_epoch, batch_idx) == (self.epoch, 1):
            raise KeyboardInterrupt


def settings(shards: Path, **section):
    return tiny_config(
        shards, layout__epochs=EPOCHS, shape__epochs=1, model__decoder__dropout=0.1,
        samples={"every": 2, "count": 5, **section},
    )  # fmt: skip


def state(path: Path) -> dict[str, torch.Tensor]:
    return read_checkpoint(path)["state_dict"]


def test_the_best_look_is_kept_and_training_never_notices(toy_shards, tmp_path):
    judge = Told(category_kl=[0.5, 0.2, 0.9, 0.3], objects=[4, 5, 6, 7])
    fit(settings(toy_shards), tmp_path / "run", trainer_options=CPU, evaluate=judge)
    folder = tmp_path / "run" / "layout"
    assert read_checkpoint(folder / "best.ckpt")["epoch"] == 3  # counted from 0: after the fourth
    # What was judged is what was kept.
    kept = state(folder / "best.ckpt")
    assert_close(judge.seen[1].logits, kept["latents.weight"], rtol=0, atol=0)
    for name, values in judge.seen[1].prior.state_dict().items():
        assert torch.equal(values, kept[f"prior.{name}"])
    assert [trained.stage for trained in judge.seen] == ["layout"] * 3 + ["shape"]
    assert not any(trained.prior.training for trained in judge.seen)

    fit(settings(toy_shards, every=0), tmp_path / "plain", trainer_options=CPU)
    for stage in ("layout", "shape"):
        one, other = (state(tmp_path / run / stage / "final.ckpt") for run in ("run", "plain"))
        assert all(torch.equal(one[name], other[name]) for name in other)
    assert not list((tmp_path / "plain").rglob("best.ckpt"))

    assert load_run(tmp_path / "run").stage == load_run(tmp_path / "run", "best").stage == "shape"
    with pytest.raises(InputError, match=r"holds no best.ckpt: its config has samples.every at 0"):
        load_run(tmp_path / "plain", "best")
    with pytest.raises(InputError, match="No checkpoint 'newest'; choose from final, best"):
        load_run(tmp_path / "run", "newest")


@pytest.mark.parametrize(
    ("metric", "told", "best"),
    [("mask_iou", [0.1, 0.4, 0.3], 4), ("overlaps", [0.1, 0.4, 0.05], 6),
     ("type_share", [float("nan"), 0.2, float("nan")], 4), ("category_kl", [1.0, 1.0, 1.0], 2)],
)  # fmt: skip
def test_each_metric_knows_which_way_is_better(toy_shards, tmp_path, metric, told, best):
    config = settings(toy_shards, metric=metric)
    judge = Told(**{metric: [*told, 0.0]})
    fit(config, tmp_path / "run", trainer_options=CPU, evaluate=judge)
    assert read_checkpoint(tmp_path / "run" / "layout" / "best.ckpt")["epoch"] == best - 1


@pytest.mark.parametrize("epoch", [3, 5])
def test_a_resumed_run_remembers_its_best(toy_shards, tmp_path, monkeypatch, epoch):
    """Stopped after one look and after two, of which the first was the best."""
    told = [0.2, 0.5, 0.3, 0.1]
    config = settings(toy_shards)
    fit(config, tmp_path / "whole", trainer_options=CPU, evaluate=Told(category_kl=told))
    with monkeypatch.context() as patch:
        patch.setattr(Stop, "epoch", epoch)
        patch.setattr(train, "StepSeed", Stop)
        with pytest.raises(KeyboardInterrupt):
            fit(config, tmp_path / "run", trainer_options=CPU, evaluate=Told(category_kl=told))
    rest = Told(category_kl=told[epoch // 2 :])
    fit(config, tmp_path / "run", resume=True, trainer_options=CPU, evaluate=rest)
    for stage in ("layout", "shape"):
        for name in ("best.ckpt", "final.ckpt", "last.ckpt"):
            one, other = (
                read_checkpoint(tmp_path / run / stage / name) for run in ("whole", "run")
            )
            assert one["epoch"] == other["epoch"]
            assert one["callbacks"] == other["callbacks"]
            assert all(torch.equal(one["state_dict"][k], other["state_dict"][k])
                       for k in one["state_dict"])  # fmt: skip
        notes = [(tmp_path / run / stage / "samples.json").read_text() for run in ("whole", "run")]
        assert notes[0] == notes[1]
    assert json.loads(notes[0])["best"] == {"metric": "category_kl", "score": 0.1, "epoch": 1}
    assert read_checkpoint(tmp_path / "run" / "layout" / "best.ckpt")["epoch"] == 1
    with (tmp_path / "run" / "layout" / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["samples/category_kl"][:3] for row in rows] == ["", "0.2", "", "0.5", "", "0.3"]


class FakeWandb(Logger):
    """Stands for wandb's logger, which would start a process."""

    def __init__(self):
        super().__init__()
        self.images, self.metrics = [], {}

    name = version = "fake"

    def log_metrics(self, metrics, step=None):
        self.metrics |= metrics

    def log_hyperparams(self, *args, **kwargs):
        pass

    def log_image(self, key, images, step):
        self.images.append((key, images[0].tolist(), step))


def test_every_logger_gets_scores_and_pictures(toy_shards, tmp_path, monkeypatch):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    fakes = {}

    def logger(name, folder):
        if name == "wandb":
            return fakes.setdefault(folder.name, FakeWandb())
        return usual(name, folder)

    usual = train.make_logger
    monkeypatch.setattr(train, "make_logger", logger)
    monkeypatch.setattr(samples, "WandbLogger", FakeWandb)
    judge = Told(category_kl=[0.5, 0.2, 0.9, 0.3], objects=[4, 5, 6, 7])
    loggers = ("csv", "tensorboard", "wandb")
    fit(settings(toy_shards), tmp_path / "run", False, loggers, CPU, judge)
    folder = tmp_path / "run" / "layout"
    images = sorted((folder / "samples").iterdir())
    assert [path.name for path in images] == ["00002.png", "00004.png", "00006.png"]
    assert np.asarray(Image.open(images[1])).tolist() == np.full((4, 6, 3), 1).tolist()
    with (folder / "metrics.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["samples/objects"] for row in rows] == ["", "4.0", "", "5.0", "", "6.0"]
    assert all(row["train/loss"] for row in rows)
    board = EventAccumulator(str(folder)).Reload()
    assert [item.value for item in board.Scalars("samples/objects")] == [4, 5, 6]
    assert [item.step for item in board.Images("samples")] == [6, 12, 18]
    assert fakes["layout"].metrics["samples/objects"] == 6
    assert [step for _, _, step in fakes["layout"].images] == [6, 12, 18]


def test_what_cannot_be_judged_is_a_sentence(toy_shards, tmp_path):
    with pytest.raises(InputError, match=r"samples.every is 2, but nothing was given to eval"):
        fit(settings(toy_shards), tmp_path / "a", trainer_options=CPU)
    assert not (tmp_path / "a").exists()
    with pytest.raises(
        InputError, match=r"samples.metric is category_kl, but there are only objects, ov"
    ):
        judge = Told(objects=[1], overlaps=[2])
        fit(settings(toy_shards), tmp_path / "b", trainer_options=CPU, evaluate=judge)
    with pytest.raises(IndexError):  # its own error comes out as it is
        judge = Told(category_kl=[])
        fit(settings(toy_shards), tmp_path / "c", trainer_options=CPU, evaluate=judge)
