"""A config and a run folder in, trained stages out."""

import signal
from pathlib import Path
from typing import Any

import lightning
import torch
from torch import nn

from sceneprior.baselines.atiss import stage as atiss3d
from sceneprior.baselines.gan.stage import GanStage
from sceneprior.baselines.sync2gen import stage as sync2gen
from sceneprior.baselines.true_boxes import TruthDataset
from sceneprior.classes import label_set
from sceneprior.config import RunConfig, dump_config, load_config
from sceneprior.data.datamodule import make_loader
from sceneprior.data.dataset import ViewDataset
from sceneprior.errors import InputError
from sceneprior.models.prior import ScenePrior
from sceneprior.training.callbacks import RollingCheckpoint, RunProgress, StepSeed, write_checkpoint
from sceneprior.training.checkpoints import STAGES_OF, checkpoint_extra, restore
from sceneprior.training.layout import LayoutStage
from sceneprior.training.loggers import LOGGERS, make_logger, quiet_lightning
from sceneprior.training.monitor import Judge, SampleMonitor
from sceneprior.training.objective import build_latents, build_prior
from sceneprior.training.shape import ShapeStage
from sceneprior.training.slurm import first_process, requeue_on_signal, slurm_plugins

FROM_VIEWS = {"layout": LayoutStage, "shape": ShapeStage, "gan": GanStage}
"""Stages that learn a prior from what cameras saw, and all but the GAN latents beside it."""
FROM_BOXES = {"atiss3d": atiss3d.build, "sync2gen": sync2gen.build}
"""Baselines that learn from true boxes in 3D; the only ones to open the ground truth."""


def fit(
    config: RunConfig,
    run: Path,
    resume: bool = False,
    loggers: tuple[str, ...] = ("csv", "tensorboard"),
    trainer_options: dict[str, Any] | None = None,
    judge: Judge | None = None,
) -> None:
    """Train the stages of `config.stages`, one after the other (`runs.STAGES_OF`).

    Args:
        config: The run's settings.
        run: Where config, checkpoints and logs go.
        resume: Continue an interrupted run: finished stages are not trained again.
        loggers: Of `csv`, `tensorboard`, `wandb`.
        trainer_options: Passed on to Lightning's Trainer (devices, accelerator, precision).
        judge: Looks at the prior every `samples.every` epochs; `tasks.watch.SampleEvaluator(config)`.

    Raises:
        InputError: the run exists and is not resumed, its settings differ from `config`, or the
            shards do not fit it; a run refused at its start leaves nothing behind.
    """
    run = Path(run)
    if config.samples.every and judge is None:
        raise InputError(
            f"samples.every is {config.samples.every}, but nobody was given to judge what is "
            "generated; pass judge=sceneprior.experiments.evaluate_samples.SampleEvaluator(config), "
            "or set it to 0."
        )
    _check_run(config, run, resume)
    for name in loggers:
        if name not in LOGGERS:
            raise InputError(f"No logger '{name}'; choose from {', '.join(LOGGERS)}.")
    previous = None
    with requeue_on_signal():
        for stage in STAGES_OF[config.stages]:
            final = run / stage / "final.ckpt"
            if not final.is_file():
                _fit_stage(
                    stage, config, run, previous, resume, loggers, trainer_options or {}, judge
                )
            previous = final


def _check_run(config: RunConfig, run: Path, resume: bool) -> None:
    if not first_process():
        return  # one of several processes: the first has checked, and the run is its own
    saved = run / "config.yaml"
    if saved.is_file():
        if not resume:
            raise InputError(
                f"{run} already holds a run; add --resume to continue it, or name another folder."
            )
        if load_config(str(saved)) != config:
            raise InputError(
                f"{saved} differs from the settings given now; resume with "
                f"`--config {saved}` or name another folder."
            )


def _fit_stage(
    stage: str,
    config: RunConfig,
    run: Path,
    previous: Path | None,
    resume: bool,
    loggers: tuple[str, ...],
    trainer_options: dict[str, Any],
    judge: Judge | None,
) -> None:
    settings = getattr(config, stage)
    dataset: ViewDataset | TruthDataset
    module: lightning.LightningModule
    room_ids: tuple[str, ...] = ()
    if stage in FROM_BOXES:
        dataset = _open_truth(config)
        module = FROM_BOXES[stage](config, dataset)
        room_ids = dataset.room_ids
    else:
        dataset = _open_data(stage, config)
        prior, latents = _start(config, dataset, previous)
        module = FROM_VIEWS[stage](prior, latents, config)
        if len(latents.weight):
            room_ids = dataset.room_ids
    folder = run / stage
    rolling = RollingCheckpoint(folder, checkpoint_extra(config, room_ids))
    callbacks = [RunProgress(f"fit {stage} (epochs)"), StepSeed(config.seed)]
    if judge is not None and config.samples.every:
        # Before the rolling checkpoint, which holds the best so far.
        callbacks.append(SampleMonitor(folder, config, stage, room_ids, judge))
    quiet_lightning()
    lightning.seed_everything(config.seed, verbose=False)
    if settings.cpu_threads is not None:
        torch.set_num_threads(settings.cpu_threads)
    trainer = _trainer(
        trainer_options,
        max_epochs=settings.epochs,
        logger=[make_logger(name, folder) for name in loggers],
        **_updates(stage, settings),
        callbacks=[*callbacks, rolling],
        plugins=slurm_plugins(),
        default_root_dir=folder,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        log_every_n_steps=1,
    )
    if stage == "gan" and trainer.world_size > 1:
        raise InputError(
            f"stages: gan trains in one process, but {trainer.world_size} were asked for; "
            "use --devices 1."
        )
    # Only now: a run that is refused leaves nothing behind.
    if trainer.is_global_zero:
        folder.mkdir(parents=True, exist_ok=True)
        dump_config(config, run / "config.yaml")
    if dataset.masks is None:  # else worker processes may make the batches
        dataset.to(trainer.strategy.root_device)
    loader = make_loader(
        dataset, settings.batch_size, config.seed, config.data.workers,
        trainer.global_rank, trainer.world_size,
    )  # fmt: skip
    last = folder / "last.ckpt"
    start = last if resume and last.is_file() else None
    before = signal.getsignal(signal.SIGINT)
    try:
        trainer.fit(module, loader, ckpt_path=start, weights_only=True)
    except SystemExit:
        # Lightning answers Ctrl-C with sys.exit(1).
        if not trainer.interrupted:
            raise
        signal.signal(signal.SIGINT, before)  # which Lightning left ignored
        raise KeyboardInterrupt from None
    write_checkpoint(trainer, folder, "final.ckpt")


def _updates(stage: str, settings: Any) -> dict[str, Any]:
    if stage == "gan":
        return {}  # two optimisers, which the module steps by itself
    return {
        "gradient_clip_val": settings.clip_gradient or None,
        "accumulate_grad_batches": settings.accumulate,
    }


def _trainer(options: dict[str, Any], **settings: Any) -> lightning.Trainer:
    try:
        return lightning.Trainer(**settings, **options)
    except (ValueError, TypeError, RuntimeError) as error:
        given = ", ".join(f"--{name} {value}" for name, value in options.items())
        reason = " ".join(str(error).split())
        raise InputError(f"Lightning cannot train with {given}: {reason}") from None


def _open_data(stage: str, config: RunConfig) -> ViewDataset:
    data = config.data
    views = data.views_per_room
    if stage == "shape" and config.shape.views_per_room:
        views = config.shape.views_per_room
    elif stage == "gan":
        views = config.gan.views_per_room
    dataset = ViewDataset(
        Path(data.shards),
        "train",
        views_per_room=views,
        rotations=4 if data.augment_rotations else 1,
        view_fraction=data.view_fraction,
        mask_step=None if stage == "layout" else data.mask_step,
        seed=config.seed,
    )
    _check_data(dataset, config)
    return dataset


def _open_truth(config: RunConfig) -> TruthDataset:
    data = config.data
    dataset = TruthDataset(Path(data.shards), "train", 4 if data.augment_rotations else 1)
    _check_data(dataset, config)
    return dataset


def _check_data(dataset: ViewDataset | TruthDataset, config: RunConfig) -> None:
    data = config.data
    if dataset.label_set != config.label_set:
        raise InputError(
            f"{data.shards} is labelled '{dataset.label_set}' but the config says "
            f"'{config.label_set}'; set label_set or point data.shards elsewhere."
        )
    if dataset.max_objects > config.model.max_objects:
        what = "tracked objects" if isinstance(dataset, ViewDataset) else "objects"
        raise InputError(
            f"A room of {data.shards} has {dataset.max_objects} {what} but "
            f"model.max_objects is {config.model.max_objects}; raise it."
        )


def _start(
    config: RunConfig, dataset: ViewDataset, previous: Path | None
) -> tuple[ScenePrior, nn.Embedding]:
    if previous is None:
        prior = build_prior(config, len(label_set(config.label_set)))
        # A GAN pairs no point of the latent space with a room.
        return prior, build_latents(config, 0 if config.stages == "gan" else len(dataset))
    prior, latents, room_ids = restore(config, previous)
    if room_ids != dataset.room_ids:
        raise InputError(
            f"{config.data.shards} no longer holds the rooms of {previous}; the shape stage "
            "needs the shards that the layout stage was trained on."
        )
    return prior, latents
