"""SLURM: a signal in time stops the job, queues it again, and the next one goes on exactly."""

import os
import signal
from pathlib import Path

import pytest
import torch
from tiny_runs import tiny_config

from sceneprior.training import fit as train
from sceneprior.training.callbacks import StepSeed
from sceneprior.training.fit import fit
from sceneprior.training.method import read_checkpoint

pytestmark = pytest.mark.slow

CPU = {"accelerator": "cpu", "devices": 1}


class Signalled(StepSeed):
    """Receives a signal in the middle of the third epoch of a stage, once."""

    number: int | None = None
    stage = "layout"

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        super().on_train_batch_start(trainer, pl_module, batch, batch_idx)
        here = Path(trainer.default_root_dir).name == self.stage
        if here and self.number and (trainer.current_epoch, batch_idx) == (2, 1):
            number, Signalled.number = self.number, None
            os.kill(os.getpid(), number)


@pytest.fixture
def slurm(monkeypatch, tmp_path) -> Path:
    """The environment of a job's only task; returns where `scontrol` writes what it was told."""
    for name, value in {
        "NTASKS": "1", "NTASKS_PER_NODE": "1", "NNODES": "1", "JOB_NAME": "prior",
        "JOB_ID": "1234", "PROCID": "0", "LOCALID": "0", "NODEID": "0",
    }.items():  # fmt: skip
        monkeypatch.setenv(f"SLURM_{name}", value)
    told = tmp_path / "told"
    scontrol = tmp_path / "bin" / "scontrol"
    scontrol.parent.mkdir()
    scontrol.write_text(f'#!/bin/sh\necho "$@" >> {told}\n')
    scontrol.chmod(0o755)
    monkeypatch.setenv("PATH", f"{scontrol.parent}:{os.environ['PATH']}")
    work = tmp_path / "work"
    work.mkdir()
    monkeypatch.chdir(work)
    monkeypatch.setattr(train, "StepSeed", Signalled)
    return told


@pytest.fixture(scope="module")
def never_stopped(toy_shards, tmp_path_factory) -> Path:
    run = tmp_path_factory.mktemp("cluster") / "run"
    fit(tiny_config(toy_shards, layout__epochs=4), run, trainer_options=CPU)
    return run


@pytest.mark.parametrize(
    ("number", "stage", "requeued"),
    [(signal.SIGUSR1, "layout", True), (signal.SIGUSR1, "shape", True),
     (signal.SIGTERM, "layout", False)],
)  # fmt: skip
def test_a_stopped_job_goes_on_as_if_it_had_not_been(
    slurm, never_stopped, toy_shards, tmp_path, monkeypatch, number, stage, requeued
):
    handlers = [signal.getsignal(item) for item in (signal.SIGUSR1, signal.SIGTERM)]
    monkeypatch.setattr(Signalled, "number", number)
    monkeypatch.setattr(Signalled, "stage", stage)
    config, run = tiny_config(toy_shards, layout__epochs=4), tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        fit(config, run, resume=True, trainer_options=CPU)  # as a job script says from the start
    assert read_checkpoint(run / stage / "last.ckpt")["epoch"] == 1
    assert slurm.is_file() == requeued
    if requeued:
        assert slurm.read_text() == "requeue 1234\n"
    assert not list(tmp_path.rglob("hpc_ckpt*")) and not list(Path.cwd().iterdir())
    assert [signal.getsignal(item) for item in (signal.SIGUSR1, signal.SIGTERM)] == handlers
    fit(config, run, resume=True, trainer_options=CPU)
    for name in ("layout", "shape"):
        wanted = read_checkpoint(never_stopped / name / "final.ckpt")["state_dict"]
        reached = read_checkpoint(run / name / "final.ckpt")["state_dict"]
        assert all(torch.equal(reached[key], wanted[key]) for key in wanted)


def test_an_array_job_is_queued_again_by_its_own_name(slurm, toy_shards, tmp_path, monkeypatch):
    monkeypatch.setenv("SLURM_ARRAY_JOB_ID", "77")
    monkeypatch.setenv("SLURM_ARRAY_TASK_ID", "3")
    monkeypatch.setattr(Signalled, "number", signal.SIGUSR1)
    with pytest.raises(KeyboardInterrupt):
        fit(tiny_config(toy_shards), tmp_path / "run", trainer_options=CPU)
    assert slurm.read_text() == "requeue 77_3\n"


def test_outside_of_slurm_signals_are_left_alone(monkeypatch):
    from sceneprior.training.callbacks import requeue_on_signal, slurm_plugins

    monkeypatch.delenv("SLURM_NTASKS", raising=False)
    before = signal.getsignal(signal.SIGUSR1)
    with requeue_on_signal():
        assert signal.getsignal(signal.SIGUSR1) == before
    assert slurm_plugins() == []
