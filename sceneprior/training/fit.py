"""Train the stages of a run, one after the other, with Lightning."""

import contextlib
import logging
import math
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
    Pictures,
    RollingCheckpoint,
    RunProgress,
    Statistics,
    StepSeed,
    check_resumable,
    copy_checkpoint,
    first_process,
    requeue_on_signal,
    write_checkpoint,
)
from sceneprior.training.method import RunConfig, Stage, read_checkpoint, without_samples
from sceneprior.training.start_from import find_source, start_from
from sceneprior.training.steps import make_loader
from sceneprior.training.trainer import LOGGERS, make_trainer, trainer_arguments, usage_errors
from sceneprior.training.validation import val_loaders

FREE = ("epochs", "val_every", "trainer", "callbacks", "logger")
"""Keys that a resumed run may change."""


def fit(
    config: RunConfig,
    run: Path | str,
    resume: bool = False,
    loggers: tuple[str, ...] = ("csv", "tensorboard"),
    trainer_options: dict[str, Any] | None = None,
    callbacks: Sequence[Callback] = (),
) -> None:
    """Train the stages that `config.stages()` lists; config, checkpoints and logs go to `run`.

    A run that is refused at its start leaves no files behind, nor does Lightning's fast_dev_run.

    Args:
        resume: Continue a run, without training its finished stages again.
        loggers: Names of `LOGGERS`.
        trainer_options: Arguments of Lightning's Trainer, before those of the section `trainer`.
        callbacks: Lightning's callbacks for every stage, called after those of `fit`.
    """
    if config.init_from and not resume:
        find_source(Path(config.init_from))  # before the shards are opened
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
            if not _is_finished(final, stage, config):
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
        before = check_settings(type(config), data, str(saved))
    except ConfigError:
        raise InputError(
            f"{saved} is of another method or version than the settings given now, or damaged; "
            "name another folder."
        ) from None
    if changed := [*_changed(before.model_dump(by_alias=True), config.model_dump(by_alias=True))]:
        raise InputError(
            f"{saved} differs from the settings given now in {', '.join(changed)}; resume with "
            f"`--config {saved}` or name another folder."
        )


def _changed(before: dict[str, Any], now: dict[str, Any], within: str = "") -> Iterator[str]:
    """Keys of the settings that differ and that a resumed run must keep."""
    for key in before.keys() | now.keys():
        old, new = before.get(key), now.get(key)
        if isinstance(old, dict) and isinstance(new, dict) and within + key not in FREE:
            yield from _changed(old, new, f"{within}{key}.")
        elif old != new and key not in FREE:
            yield within + key


def _is_finished(final: Path, stage: Stage, config: RunConfig) -> bool:
    """False if the stage has no final.ckpt, or one of fewer epochs than the settings ask for; an
    `InputError` if it is damaged, or cannot be trained longer."""
    if not final.is_file():
        return False
    saved, asked = read_checkpoint(final), stage.settings.epochs
    done = saved.get("sceneprior", {}).get("epochs", saved.get("epoch"))
    after = config.stage_names[config.stage_names.index(stage.name) + 1 :]
    begun = any((final.parents[1] / name).exists() for name in after)
    if done != asked and (done > asked or begun or not final.with_name("last.ckpt").is_file()):
        raise InputError(
            f"{final} was trained for {done} epochs, and the settings ask for {asked}. A stage can "
            "be trained longer while its last.ckpt is there and no later stage has begun; else "
            f"name another folder, and start with its weights (--init-from {final})."
        )
    return bool(done == asked)


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
    last = folder / "last.ckpt"
    start = last if resume and last.is_file() else None
    if previous is None and config.init_from and start is None:
        start_from(Path(config.init_from), module, config.label_set, room_ids)
    said = {"room_ids": room_ids, "label_set": config.label_set, "epochs": settings.epochs}
    monitor = "train/loss" if settings.keep == "lowest" else "val/loss"
    rolling = RollingCheckpoint(folder, {"sceneprior": said}, monitor)
    callbacks = [
        RunProgress(f"fit {stage.name} (epochs)"), StepSeed(config.seed), Statistics(),
        Pictures(config, stage, room_ids), rolling, *callbacks,
    ]  # fmt: skip
    # Lightning's hints are silenced; GPUs that can multiply matrices fast (TF32) may do so.
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    logging.getLogger("lightning.fabric").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", module="lightning")
    torch.set_float32_matmul_precision("high")
    lightning.seed_everything(config.seed, verbose=False)
    repeated = arguments.get("overfit_batches")  # Lightning's own would replace our sampler
    if repeated:
        arguments = arguments | {"limit_train_batches": repeated, "overfit_batches": 0.0}
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
    process = trainer.global_rank, trainer.world_size
    loader = make_loader(
        rooms, settings.batch_size, config.seed, config.data.workers, *process, bool(repeated)
    )
    held_out = val_loaders(stage, module, rooms, Path(config.data.shards), *process)
    if start is not None:
        check_resumable(start, module)
    before = signal.getsignal(signal.SIGINT)
    try:
        with usage_errors(arguments):
            trainer.fit(module, loader, held_out, ckpt_path=start, weights_only=True)
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
    if settings.keep != "last" and rolling.best < math.inf:
        copy_checkpoint(trainer, folder, "best.ckpt", "final.ckpt")
    else:
        if settings.keep != "last":
            why = f"keep is '{settings.keep}', but no epoch has a {monitor}"
            warnings.warn(f"{why}; so the last epoch is kept.", InputWarning, 2)
        write_checkpoint(trainer, folder, "final.ckpt")


def _version() -> dict[str, str]:
    """The package's version, and its git commit, which is empty outside of a repository."""
    command, commit = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"], ""
    with contextlib.suppress(OSError):
        commit = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    return {"version": sceneprior.__version__, "commit": commit.strip()}


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
