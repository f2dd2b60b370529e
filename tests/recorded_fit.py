"""Train as `fit` does and write down each step's gradients and latents; a script, for two.

    python tests/recorded_fit.py CONFIG FOLDER POISON

Trains in FOLDER/two and writes FOLDER/steps.pt. Then resumes a copy of the run, FOLDER/poisoned,
whose shape stage is missing, with a latent that is no number in row POISON; each process
writes what it said to FOLDER/said_<rank>.
"""

import shutil
import sys
from pathlib import Path

import torch
from lightning.pytorch.callbacks import Callback

from sceneprior.apps.config import load_config
from sceneprior.training.callbacks import first_process
from sceneprior.training.fit import fit


class Recorder(Callback):
    """Records the inputs and results of every step of every stage in `steps`."""

    def __init__(self) -> None:
        self.steps: list[dict[str, torch.Tensor]] = []

    def on_before_optimizer_step(self, trainer, pl_module, optimizer) -> None:
        gradients = {
            f"gradient/{name}": item.grad.clone()
            for name, item in pl_module.named_parameters()
            if item.grad is not None
        }
        self.steps.append(gradients | {"before/latents": pl_module.latents.weight.detach().clone()})

    def on_train_batch_end(self, trainer, pl_module, outputs, batch, batch_idx) -> None:
        if not self.steps:
            return  # still accumulating
        self.steps[-1]["latents"] = pl_module.latents.weight.detach().clone()
        self.steps[-1]["loss"] = outputs["loss"].detach()


class Poison(Callback):
    """Spoils the latent of one room."""

    def __init__(self, row: int):
        self.row = row

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx) -> None:
        with torch.no_grad():
            pl_module.latents.weight[self.row] = torch.nan


def record(config, run: Path, devices: int, **options) -> list[dict[str, torch.Tensor]]:
    """Train, and return the steps of all stages in one list; of several processes, the first's."""
    recorder = Recorder()
    options = {"accelerator": "cpu", "devices": devices, **options}
    fit(config, run, trainer_options=options, loggers=("csv",), callbacks=[recorder])
    return recorder.steps


def poison(config, run: Path, row: int) -> str:
    """Resume a run with two processes after a latent is spoilt, and return the error message."""
    try:
        fit(config, run, True, ("csv",), {"accelerator": "cpu", "devices": 2}, [Poison(row)])
    except FloatingPointError as error:
        return str(error)
    return "nothing"


if __name__ == "__main__":
    torch.set_num_threads(1)
    config, folder = load_config(sys.argv[1]), Path(sys.argv[2])
    steps = record(config, folder / "two", 2)
    if first_process():
        torch.save(steps, folder / "steps.pt")
        run = shutil.copytree(folder / "two", folder / "poisoned")
        shutil.rmtree(run / "shape")
        (run / "layout" / "final.ckpt").unlink()
    torch.distributed.barrier()
    said = poison(config, folder / "poisoned", int(sys.argv[3]))
    (folder / f"said_{torch.distributed.get_rank()}").write_text(said)
