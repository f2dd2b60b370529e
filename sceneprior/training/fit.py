"""Train the stages of a run, one after the other, with Lightning."""

import contextlib
import logging
import pkgutil
import shutil
import signal
import subprocess
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import lightning
import torch
from lightning.pytorch.callbacks import Callback

import sceneprior
from sceneprior.core.checked import shown
from sceneprior.core.errors import ConfigError, InputError, InputWarning, cause_of
from sceneprior.core.files import only_writer, read_json, remove_parts
from sceneprior.core.settings import check_settings, dump_settings, read_settings
from sceneprior.training.callbacks import (
    RollingCheckpoint,
    RunProgress,
    StepSeed,
    check_resumable,
    first_process,
    requeue_on_signal,
    write_checkpoint,
)
from sceneprior.training.method import RunConfig, Stage, read_checkpoint, without_samples
from sceneprior.training.steps import make_loader
from sceneprior.training.trainer import LOGGERS, make_trainer, trainer_arguments, usage_errors


def fit(
    config: RunConfig,
    run: Path,
    resume: bool = False,
    loggers: tuple[str, ...] = ("csv", "tensorboard"),
    trainer_options: dict[str, Any] | None = None,
    callbacks: Sequence[Callback] = (),
) -> None:
    """Train the stages that `config.stages()` lists; config, checkpoints and logs go to `run`.

    A run that is refused at its start leaves no files behind, and neither does one with Lightning's
    `fast_dev_run`.

    Args:
        resume: Continue an interrupted run, without training its finished stages again.
        loggers: Names of `LOGGERS`.
        trainer_options: Arguments of Lightning's Trainer (devices, precision, max_steps), which
            replace those of the section `trainer`.
        callbacks: Lightning's callbacks for every stage, called after those of `fit`.
    """
    run, config = Path(run), config.with_label_set()
    for name in loggers:
        if name not in LOGGERS:
            raise InputError(f"No logger '{name}'; choose from {', '.join(LOGGERS)}.")
    arguments = trainer_arguments(config, trainer_options or {})
    if arguments.get("fast_dev_run"):
        run = run.with_name(f"{run.name}.fast_dev_run")
    previous = None
    with _own_folder(run), requeue_on_signal():
        if first_process():
            _check_run(config, run, resume)
        for stage in config.stages():
            final = run / stage.name / "final.ckpt"
            if final.is_file():
                read_checkpoint(final)  # raises an error if it is damaged
            else:
                own = list(callbacks)
                _train(stage, config, final.parent, previous, resume, loggers, arguments, own)
            previous = final
        if arguments.get("fast_dev_run") and first_process():
            shutil.rmtree(run, ignore_errors=True)


@contextlib.contextmanager
def _own_folder(run: Path) -> Iterator[None]:
    """Lock a run's folder against other trainings; only the run's first process holds the lock."""

    def report(ended: threading.ExceptHookArgs) -> None:
        if ended.exc_type is None or not issubclass(ended.exc_type, OSError):
            report_before(ended)

    # TensorBoard writes in a thread; its errors are raised again in the main thread, so the
    # thread's own report is left out.
    report_before, threading.excepthook = threading.excepthook, report
    try:
        with only_writer(run) if first_process() else contextlib.nullcontext():
            yield
    except OSError as error:
        error.filename = error.filename or str(run)  # a logger's error may not name its file
        raise
    finally:
        threading.excepthook = report_before


def _check_run(config: RunConfig, run: Path, resume: bool) -> None:
    saved = run / "config.yaml"
    if not saved.is_file():
        return
    if not resume:
        raise InputError(
            f"{run} already holds a run; add --resume to continue it, or name another folder."
        )
    try:
        data = without_samples(read_settings(str(saved))[1], str(saved))
        same = check_settings(type(config), data, str(saved)) == config
    except ConfigError:
        raise InputError(
            f"{saved} is of another method or version than the settings given now, or damaged; "
            "name another folder."
        ) from None
    if not same:
        raise InputError(
            f"{saved} differs from the settings given now; resume with "
            f"`--config {saved}` or name another folder."
        )


def _train(
    stage: Stage,
    config: RunConfig,
    folder: Path,
    previous: Path | None,
    resume: bool,
    loggers: tuple[str, ...],
    arguments: dict[str, Any],
    callbacks: list[Callback],
) -> None:
    """Train one stage in its folder to the end, or until Ctrl-C."""
    settings = stage.settings
    # Before anything is computed, since the prototypes' codes depend on the rounding of sums, too.
    torch.set_num_threads(settings.cpu_threads or 1)
    rooms = stage.open_data()
    if previous is None and first_process():
        warn_of_losses(Path(config.data.shards), len(rooms.plain_ids))
    module = stage.build(rooms, previous)
    latents = getattr(module, "latents", None)
    pairs_no_room = latents is not None and not len(latents.weight)  # the table is empty
    room_ids = [] if pairs_no_room else [*rooms.room_ids]
    said = {"sceneprior": {"room_ids": room_ids, "label_set": config.label_set}}
    rolling = RollingCheckpoint(folder, said)
    callbacks = [
        RunProgress(f"fit {stage.name} (epochs)"), StepSeed(config.seed), rolling, *callbacks
    ]  # fmt: skip
    # Lightning's hints are silenced; GPUs that can multiply matrices fast (TF32) may do so.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    torch.set_float32_matmul_precision("high")
    lightning.seed_everything(config.seed, verbose=False)
    arguments = dict(arguments)
    if repeated := arguments.pop("overfit_batches", 0):
        arguments["limit_train_batches"] = repeated
    trainer = make_trainer(stage, config, folder, loggers, arguments, callbacks)
    module.save_hyperparameters({**config.model_dump(mode="json", by_alias=True), **_version()})
    # Written only now: a run that is refused leaves no files behind.
    if trainer.is_global_zero:
        folder.mkdir(parents=True, exist_ok=True)
        remove_parts(folder)  # left by a process killed while saving
        dump_settings(config, folder.parent / "config.yaml")
    use_graphs = getattr(module, "use_graphs", None)
    with_graphs = use_graphs is not None and use_graphs(trainer)
    # With masks, worker processes may load the batches; for CUDA graphs, the host counts objects.
    if rooms.masks is None and not with_graphs:
        rooms.to(trainer.strategy.root_device)
    loader = make_loader(
        rooms, settings.batch_size, config.seed, config.data.workers,
        trainer.global_rank, trainer.world_size, repeated=bool(repeated),
    )  # fmt: skip
    last = folder / "last.ckpt"
    start = last if resume and last.is_file() else None
    if start is not None:
        check_resumable(start, module)
    before = signal.getsignal(signal.SIGINT)
    try:
        with usage_errors(arguments):
            trainer.fit(module, loader, ckpt_path=start, weights_only=True)
    except SystemExit:
        # Lightning answers Ctrl-C with sys.exit(1).
        if not trainer.interrupted:
            raise
        signal.signal(signal.SIGINT, before)  # Lightning leaves it ignored
        raise KeyboardInterrupt from None
    except (
        TypeError, ValueError, LookupError, AttributeError, ArithmeticError, RuntimeError
    ) as error:  # fmt: skip
        # What is wrong in a checkpoint may show as late as in its first epoch, but so may others.
        own = isinstance(error, InputError | FloatingPointError | torch.OutOfMemoryError)
        if start is None or rolling.written or own:
            raise
        raise InputError(
            f"Training ended in the first epoch after it was resumed from {start} "
            f"({type(error).__name__}: {cause_of(error)}). If a run from the start ends so, too, "
            "the checkpoint is not the cause."
        ) from error
    finally:
        if "wandb" in loggers:  # otherwise it would log the next stage to the same run
            pkgutil.resolve_name("wandb:finish")()
    write_checkpoint(trainer, folder, "final.ckpt")


def _version() -> dict[str, str]:
    """The package's version, and its git commit if it runs from a repository."""
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    said = {"version": sceneprior.__version__}
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        found = subprocess.run(command, capture_output=True, text=True, check=True)
        said["commit"] = found.stdout.strip()
    return said


def warn_of_losses(shards: Path, rooms: int) -> None:
    """Warn if fewer training rooms are found than were prepared, or if a third of the objects has
    no class, by the report of the shards; nothing is said without a report."""
    with contextlib.suppress(InputError, KeyError, TypeError, AttributeError):
        report = read_json(shards / "report.json")
        there = report["counts"]["train"]["rooms"]
        if rooms < there:
            said = f"{rooms} of the {there} rooms prepared for 'train' are left in {shards}"
            warnings.warn(f"Only {said}; prepare them again.", InputWarning, stacklevel=1)
        lines = [line for line in report["rooms"] if line["status"] == "prepared"]
        keys = "classes", "unknown_categories"
        known, unknown = (sum(sum(line[key].values()) for line in lines) for key in keys)
        if 2 * unknown >= known > 0:
            named = ", ".join(map(shown, [*report["unknown_categories"]][:5]))
            said = f"{unknown} objects of {shards} have no class, and {known} objects have"
            why = f"their names ({named}) are not in the label set, so they are not learned"
            warnings.warn(f"{said} one: {why}.", InputWarning, stacklevel=1)
