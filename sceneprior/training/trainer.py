"""Lightning's Trainer of a stage: a run's sections `trainer`, `callbacks` and `logger`, and what
Lightning refuses, as `InputError`s."""

import difflib
import inspect
import os
import sys
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lightning
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.cli import instantiate_class
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger
from lightning.pytorch.plugins.environments import SLURMEnvironment
from torch.distributed import DistNetworkError

from sceneprior.core.errors import ConfigError, InputError, InputWarning, cause_of
from sceneprior.training.callbacks import first_process, slurm_plugins
from sceneprior.training.method import RunConfig, Stage, read_metrics

LOGGERS = ("csv", "tensorboard", "wandb")
"""Names of the loggers that `fit` accepts."""
ELSEWHERE = {
    "max_epochs": "set `epochs` in the section of the stage",
    "gradient_clip_val": "set `clip_gradient` in the section of the stage",
    "accumulate_grad_batches": "set `accumulate` in the section of the stage",
    "check_val_every_n_epoch": "set `val_every` in the section of the stage",
    "callbacks": "use the section `callbacks`",
    "logger": "use the section `logger` and `--logger`",
    "default_root_dir": "use `--run`",
    "enable_checkpointing": "`fit` writes the checkpoints itself",
    "use_distributed_sampler": "`fit` divides the rooms among processes itself",
    "inference_mode": "latents of val rooms need gradients",
    "plugins": "`fit` sets those of SLURM itself",
}
"""Arguments of the Trainer that `fit` sets itself, and where they are set instead."""
PRECISIONS = ("32-true", "bf16-mixed", "32", "bf16", 32)
"""Precisions that train: float16 needs gradients scaled until they are infinite, which would stop
the run, and losses in float32 do not fit weights in bfloat16 or float64."""


def trainer_arguments(config: RunConfig, options: dict[str, Any]) -> dict[str, Any]:
    """Arguments of Lightning's Trainer from the run's section `trainer` and, with precedence,
    `options`; a `ConfigError` if the Trainer or a stage does not support one."""
    given = config.trainer | {name: value for name, value in options.items() if value is not None}
    known = inspect.signature(lightning.Trainer).parameters
    for name in given:
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1, cutoff=0.0)[0]
            raise ConfigError(f"trainer.{name} is no argument of Lightning's; is '{near}' meant?")
        if name in ELSEWHERE:
            warnings.warn(f"trainer.{name} is left out: {ELSEWHERE[name]}.", InputWarning, 2)
    if given.get("precision", "32-true") not in PRECISIONS:
        raise ConfigError(
            f"precision is '{given['precision']}', which is not supported: losses are computed in "
            "32 bits, and gradients are not scaled. Use 32-true or bf16-mixed."
        )
    return {name: value for name, value in given.items() if name not in ELSEWHERE}


def make_trainer(
    stage: Stage,
    config: RunConfig,
    folder: Path,
    loggers: tuple[str, ...],
    arguments: dict[str, Any],
    callbacks: list[Callback],
) -> lightning.Trainer:
    """The Trainer of a stage whose files go to `folder`, with `trainer_arguments`."""
    settings = stage.settings
    free = {"enable_progress_bar": False, "enable_model_summary": False, "num_sanity_val_steps": 0}
    ours: dict[str, Any] = {
        "max_epochs": settings.epochs,
        "check_val_every_n_epoch": settings.val_every or 1,
        "inference_mode": False,
        "callbacks": [*callbacks, *configured_callbacks(config)],
        "plugins": slurm_plugins(),
        "default_root_dir": folder,
        "enable_checkpointing": False,
        "use_distributed_sampler": False,
        "logger": False,
    }
    if not stage.steps_itself:
        ours["gradient_clip_val"] = settings.clip_gradient or None
        ours["accumulate_grad_batches"] = settings.accumulate
    with usage_errors(arguments, ValueError, TypeError, RuntimeError):
        trainer = lightning.Trainer(**free | {"log_every_n_steps": 1} | arguments | ours)
    tasks = os.environ.get("SLURM_NTASKS_PER_NODE", str(trainer.num_devices))
    if SLURMEnvironment.detect() and tasks != str(trainer.num_devices):
        raise InputError(
            f"SLURM starts {tasks} processes per node (--ntasks-per-node), but the number of "
            f"devices is {trainer.num_devices}; use --devices {tasks}."
        )
    if stage.steps_itself and trainer.world_size > 1:
        raise InputError(
            f"method: {config.method} trains in one process, but {trainer.world_size} were "
            "asked for; use --devices 1."
        )
    if not getattr(trainer, "fast_dev_run", False):
        # Opened last, since a run that is refused leaves no files behind.
        given: Any = config.logger
        trainer.loggers = [make_logger(name, folder, given.get(name)) for name in loggers]
    return trainer


@contextmanager
def usage_errors(arguments: dict[str, Any], *others: type[Exception]) -> Iterator[None]:
    """Raise what Lightning says of its usage, taken ports, and `others` as an `InputError`."""
    caught: tuple[type[Exception], ...] = (MisconfigurationException, ValueError, RuntimeError)
    try:
        yield
    except caught + others as error:
        *_, (frame, _) = traceback.walk_tb(error.__traceback__)
        by_lightning = frame.f_globals.get("__name__", "").startswith("lightning.")
        loader, port = str(error).startswith("DataLoader"), isinstance(error, DistNetworkError)
        usage = by_lightning or loader or isinstance(error, (MisconfigurationException, *others))
        if isinstance(error, InputError) or not (usage or port):
            raise
        given = ", ".join(f"{name} {value}" for name, value in arguments.items())
        then = " Set data.workers to 0, or allow more shared memory." * loader
        then += " Its port may be taken: set MASTER_PORT to a free one." * port
        raise InputError(
            f"Lightning cannot train with {given or 'these settings'}: "
            f"{cause_of(error).rstrip('.!')}.{then}"
        ) from None


def configured_callbacks(config: RunConfig) -> list[Callback]:
    """The callbacks of the section `callbacks`; modules are also found in the current folder."""
    found = []
    for path, arguments in (pair for entry in config.callbacks for pair in entry.items()):
        sys.path.insert(0, str(Path.cwd()))
        try:
            made = instantiate_class((), {"class_path": path, "init_args": arguments or {}})
        except Exception as error:  # whatever a user's own module raises
            raise ConfigError(f"callbacks: {path} cannot be made: {cause_of(error)}.") from None
        finally:
            sys.path.remove(str(Path.cwd()))
        if not isinstance(made, Callback):
            raise ConfigError(f"callbacks: {path} is no lightning.pytorch.callbacks.Callback.")
        found.append(made)
    return found


def make_logger(name: str, folder: Path, given: dict[str, Any] | None = None) -> Logger:
    """Make a logger for a stage's folder; `name` is one of `LOGGERS`, and `given` are arguments of
    Lightning's class. The CSV logger appends to the file of an interrupted run."""
    given = given or {}
    plain: dict[str, Any] = {"name": "", "version": ""}
    try:
        if name == "tensorboard":
            return TensorBoardLogger(folder, **plain | {"default_hp_metric": False} | given)
        if name == "csv":
            # Lightning's CSVLogger deletes an existing file, so it is given its earlier rows.
            before = read_metrics(folder / "metrics.csv")
            logger = CSVLogger(folder, **plain | given)
            if before and first_process():
                logger.experiment.metrics.extend(before)
                logger.save()
            return logger
        import wandb
        from lightning.pytorch.loggers import WandbLogger

        inspect.signature(wandb.init).bind(**given)  # the logger itself would pass on any argument
        key = os.environ.get("WANDB_API_KEY") or Path("~/.netrc").expanduser().is_file()
        run = folder.parent.name
        named: dict[str, Any] = {
            "project": "sceneprior",
            "group": run,
            "name": f"{run}/{folder.name}",
        }
        return WandbLogger(**named | {"save_dir": folder, "offline": not key} | given)
    except TypeError as error:
        raise ConfigError(f"logger.{name}: {cause_of(error)}.") from None
