"""Loggers of a stage (CSV, TensorBoard, W&B); quietens Lightning."""

import csv
import logging
import os
import warnings
from pathlib import Path

import torch
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger

from sceneprior.training.slurm import first_process

LOGGERS = ("csv", "tensorboard", "wandb")


def make_logger(name: str, folder: Path) -> Logger:
    """One of `LOGGERS`, for a stage's folder; CSV goes on where a stopped run's ended."""
    if name == "csv":
        return _csv_logger(folder)
    if name == "tensorboard":
        return TensorBoardLogger(folder, name="", version="")
    from lightning.pytorch.loggers import WandbLogger

    key = os.environ.get("WANDB_API_KEY") or Path("~/.netrc").expanduser().is_file()
    return WandbLogger(project="sceneprior", save_dir=folder, name=folder.name, offline=not key)


def _csv_logger(folder: Path) -> CSVLogger:
    # Lightning's deletes what it finds: hand it the rows of the epochs before the stop.
    path = folder / "metrics.csv"
    before = list(csv.DictReader(path.read_text().splitlines())) if path.is_file() else []
    logger = CSVLogger(folder, name="", version="")
    if before and first_process():
        logger.experiment.metrics.extend(before)
        logger.save()
    return logger


def quiet_lightning() -> None:
    """Leave out Lightning's hints, and let matrix products be fast where a GPU has such."""
    # Its hints (loader workers, litlogger, cores) are for other set-ups than this one.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    torch.set_float32_matmul_precision("high")
