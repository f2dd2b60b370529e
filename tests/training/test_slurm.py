"""SLURM: a job that is preempted stops, and the next one goes on exactly."""

import os
import signal

import pytest
import torch
from tiny_runs import tiny_config

from sceneprior.training import fit as train
from sceneprior.training.callbacks import StepSeed
from sceneprior.training.checkpoints import read_checkpoint
from sceneprior.training.fit import fit
from sceneprior.training.slurm import slurm_plugins

CPU = {"accelerator": "cpu", "devices": 1}


class Signalled(StepSeed):
    """Receives SIGTERM in the middle of the third epoch of the layout stage, once."""

    sent = False

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        super().on_train_batch_start(trainer, pl_module, batch, batch_idx)
        if not Signalled.sent and (trainer.current_epoch, batch_idx) == (2, 1):
            Signalled.sent = True
            os.kill(os.getpid(), signal.SIGTERM)


@pytest.fixture
def slurm(monkeypatch) -> None:
    """The environment of a job's only task."""
    for name, value in {
        "NTASKS": "1", "NTASKS_PER_NODE": "1", "NNODES": "1", "JOB_NAME": "prior",
        "JOB_ID": "1234", "PROCID": "0", "LOCALID": "0", "NODEID": "0",
    }.items():  # fmt: skip
        monkeypatch.setenv(f"SLURM_{name}", value)


def test_a_preempted_job_goes_on_as_if_it_had_not_been(slurm, toy_shards, tmp_path, monkeypatch):
    config, run, whole = tiny_config(toy_shards), tmp_path / "run", tmp_path / "whole"
    fit(config, whole, trainer_options=CPU)
    monkeypatch.setattr(train, "StepSeed", Signalled)
    with pytest.raises(KeyboardInterrupt):
        fit(config, run, resume=True, trainer_options=CPU)  # as a job script says from the start
    assert read_checkpoint(run / "layout" / "last.ckpt")["epoch"] == 1
    assert not list(tmp_path.rglob("hpc_ckpt*"))
    fit(config, run, resume=True, trainer_options=CPU)
    for name in ("layout", "shape"):
        wanted = read_checkpoint(whole / name / "final.ckpt")["state_dict"]
        reached = read_checkpoint(run / name / "final.ckpt")["state_dict"]
        assert all(torch.equal(reached[key], wanted[key]) for key in wanted)


def test_lightning_queues_no_job_again(slurm, monkeypatch):
    (plugin,) = slurm_plugins()
    assert not plugin.auto_requeue
    monkeypatch.delenv("SLURM_NTASKS")
    assert slurm_plugins() == []
