"""The sections `trainer`, `callbacks` and `logger` of a run, and what Lightning refuses."""

import csv
from collections import namedtuple
from pathlib import Path

import pytest
from interrupting import CPU
from lightning.pytorch.callbacks import Callback
from refusals import refused
from tiny_runs import tiny_config

import sceneprior
from sceneprior.core.errors import InputWarning
from sceneprior.training.fit import fit
from sceneprior.training.method import read_checkpoint
from sceneprior.training.trainer import make_logger

REFUSED = {
    "unknown argument": ({"trainer": {"max_step": 3}}, {}),
    "16-mixed": ({}, {"precision": "16-mixed"}),
    "64-true": ({}, {"precision": "64-true"}),
    "no such callback": ({"callbacks": [{"lightning.pytorch.callbacks.Stopping": None}]}, {}),
    "no callback": ({"callbacks": [{"pathlib.Path": None}]}, {}),
    "callback's argument": (
        {"callbacks": [{"lightning.pytorch.callbacks.EarlyStopping": {"monitor": "a", "b": 1}}]},
        {},
    ),
    "gpu": ({"trainer": {"accelerator": "gpu"}}, {"accelerator": None}),
    "no device": ({}, {"devices": "three"}),
    "profiler": ({"trainer": {"profiler": "mine"}}, {}),
    "missing metric": (
        {"callbacks": [{"lightning.pytorch.callbacks.EarlyStopping": {"monitor": "no/such"}}]},
        {},
    ),
    "logger's argument": ({"logger": {"wandb": {"projekt": "rooms"}}}, {}),
}
"""Changed settings of the config, and options of `fit`."""


@pytest.mark.parametrize("name", REFUSED)
def test_what_lightning_refuses_is_a_sentence(toy_shards, tmp_path, name, monkeypatch):
    monkeypatch.setattr("torch.cuda.device_count", lambda: 0)
    changes, options = REFUSED[name]
    loggers = ("wandb",) if name == "logger's argument" else ()
    with refused(f"training/{name}"):
        fit(tiny_config(toy_shards, **changes), tmp_path / "run", False, loggers, CPU | options)
    assert name == "missing metric" or not list(tmp_path.iterdir())


def test_devices_are_as_many_as_slurms_tasks(toy_shards, tmp_path, monkeypatch):
    for name, value in {"NTASKS": "4", "NTASKS_PER_NODE": "4", "JOB_NAME": "prior"}.items():
        monkeypatch.setenv(f"SLURM_{name}", value)
    for name in ("JOB_ID", "PROCID", "LOCALID", "NODEID"):
        monkeypatch.setenv(f"SLURM_{name}", "0")
    with refused("training/slurm"):
        fit(tiny_config(toy_shards), tmp_path / "run", trainer_options=CPU)
    assert not list(tmp_path.iterdir())


def test_workers_need_shared_memory(toy_shards, tmp_path, monkeypatch):
    seen, free = Seen(), namedtuple("usage", "free")
    monkeypatch.setattr("shutil.disk_usage", lambda path: free(20000))
    config = tiny_config(toy_shards, layout__epochs=1, shape__epochs=1, data__workers=2)
    with pytest.warns(InputWarning, match="2 workers need 0 MB of shared memory, and /dev/shm has"):
        fit(config, tmp_path / "run", False, (), CPU, [seen])
    assert seen.trainer.train_dataloader.num_workers == 0

    def stuck(*_):
        raise RuntimeError("DataLoader timed out after 600 seconds")

    monkeypatch.setattr("sceneprior.paper.stages.LayoutStage.training_step", stuck)
    with refused("training/stuck loader"):
        fit(config, tmp_path / "stuck", False, (), CPU)


class Seen(Callback):
    """The rooms and cameras of every batch, and the Trainer."""

    def __init__(self):
        self.batches = []

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        self.batches.append((batch.room_ids, batch.world_to_camera))
        self.trainer = trainer


def test_arguments_and_callbacks_reach_lightning(toy_shards, tmp_path, monkeypatch):
    """And what the run's own sections set is not overruled."""
    (tmp_path / "of_mine.py").write_text(
        "from lightning.pytorch.callbacks import Callback\n"
        "class Note(Callback):\n"
        "    def __init__(self, path): self.path = path\n"
        "    def on_train_end(self, trainer, pl_module): open(self.path, 'a').write('ended ')\n"
    )
    monkeypatch.chdir(tmp_path)
    note, seen = tmp_path / "note", Seen()
    config = tiny_config(
        toy_shards,
        trainer={"max_steps": 4, "max_epochs": 1, "log_every_n_steps": 5},
        callbacks=[{"of_mine.Note": {"path": str(note)}}],
    )
    with pytest.warns(InputWarning, match="trainer.max_epochs is left out: set `epochs`"):
        fit(config, Path("run"), trainer_options=CPU | {"log_every_n_steps": 2}, callbacks=[seen])
    assert note.read_text() == "ended ended "  # of both stages
    assert (seen.trainer.max_epochs, seen.trainer.log_every_n_steps) == (3, 2)
    for stage in ("layout", "shape"):
        saved = read_checkpoint(Path("run", stage, "final.ckpt"))
        assert saved["global_step"] == 4
        hparams = saved["hyper_parameters"]
        assert hparams["version"] == sceneprior.__version__ and hparams["layout"]["epochs"] == 6
        assert "max_steps: 4" in Path("run", stage, "hparams.yaml").read_text()


def test_one_batch_is_repeated(toy_shards, tmp_path):
    seen = Seen()
    config = tiny_config(toy_shards, layout__epochs=3, trainer={"overfit_batches": 1})
    fit(config, tmp_path / "run", False, ("csv",), CPU, [seen])
    batches = seen.batches[:3]
    assert all(rooms == batches[0][0] for rooms, _ in batches)
    assert all(cameras.equal(batches[0][1]) for _, cameras in batches)
    with (tmp_path / "run" / "layout" / "metrics.csv").open() as file:
        losses = [float(row["train/loss"]) for row in csv.DictReader(file) if row["train/loss"]]
    assert losses == sorted(losses, reverse=True)


def test_a_dry_run_trains_every_stage_and_leaves_nothing(toy_shards, tmp_path):
    seen = Seen()
    config = tiny_config(toy_shards, trainer={"fast_dev_run": True})
    fit(config, tmp_path / "run", trainer_options=CPU, callbacks=[seen])
    assert len(seen.batches) == 2 and not list(tmp_path.iterdir())


def test_weights_and_biases_tells_runs_and_stages_apart(tmp_path, monkeypatch):
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    named = make_logger("wandb", tmp_path / "small_net" / "shape")._wandb_init
    assert named["name"] == "small_net/shape" and named["group"] == "small_net"
    given = {"project": "rooms", "tags": ["small"], "name": "mine"}
    named = make_logger("wandb", tmp_path / "small_net" / "shape", given)._wandb_init
    assert named.items() >= (given | {"group": "small_net"}).items()
