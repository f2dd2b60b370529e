"""Ctrl-C in the middle of a training."""

from pathlib import Path

import pytest

from sceneprior.training import fit as train
from sceneprior.training.callbacks import RollingCheckpoint

CPU = {"accelerator": "cpu", "devices": 1}


def interrupted(config, run: Path, stage: str, epoch: int, resume: bool = False) -> None:
    """Train until the second batch of an epoch of a stage, and press Ctrl-C there."""

    class Stop(RollingCheckpoint):
        def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
            if (self.folder.name, trainer.current_epoch, batch_idx) == (stage, epoch, 1):
                raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(train, "RollingCheckpoint", Stop)
        with pytest.raises(KeyboardInterrupt):
            train.fit(config, run, resume, trainer_options=CPU)
