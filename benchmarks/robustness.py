"""Train on spoilt masks and poses, with and without what is meant to help; print what was learnt.

Run `python benchmarks/robustness.py --shards DIR`. The first rooms of the shards' training split
are read into memory and their observations spoilt there, by the same seed for every row: the
truth in 3D, which the scores are taken from, stays as it is. Each row trains the layout stage
alone, from the same start and for as many steps.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import lightning
import torch
from torch import Tensor

from sceneprior.classes import label_set
from sceneprior.config import RunConfig, load_config
from sceneprior.data.datamodule import make_loader
from sceneprior.data.dataset import ViewDataset
from sceneprior.data.flat_views import FlatViews
from sceneprior.evaluation.layout_metrics import (
    category_kl,
    object_counts,
    overlap_pairs,
    reconstruction_scores,
)
from sceneprior.evaluation.reference import reference_scenes
from sceneprior.stages.layout import LayoutStage
from sceneprior.stages.runs import TrainedPrior
from sceneprior.stages.train import _quiet_lightning
from sceneprior.stages.view_loss import build_latents, build_prior
from sceneprior.tasks.decode import decode_training_rooms, synthesize

CONFIG = Path(__file__).parents[1] / "configs" / "front_bedroom_small.yaml"


def spoil_masks(flat: FlatViews, share: float, seed: int) -> FlatViews:
    """Jitter every 2D box by 1% of the image; of `share` of the sightings make wrong ones.

    A third of the wrong ones are moved by up to a quarter of the image, a third cut to a half of
    their box, as masks are that fall apart, and a third take the next object's box of the same
    view, as where ids are swapped. As many more again are not seen.
    """
    generator = torch.Generator().manual_seed(seed)
    count = len(flat.boxes)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    boxes = flat.boxes + 0.01 * torch.randn(count, 4, generator=generator)
    what = uniform(count)
    moved = boxes + (uniform(count, 2) - 0.5).mul(0.5).repeat(1, 2)
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    cut = boxes.clone()
    low, right = uniform(count) < 0.5, uniform(count) < 0.5
    column = torch.where(right, 0, 1) + torch.where(low, 0, 2)
    cut[torch.arange(count), column] = middle[torch.arange(count), column % 2]
    beside = torch.arange(count).roll(-1)
    swapped = torch.where(flat.visible[beside, None], boxes[beside], boxes)
    for index, wrong in enumerate((moved, cut, swapped)):
        chosen = (what >= index * share / 3) & (what < (index + 1) * share / 3)
        boxes = torch.where(chosen[:, None], wrong, boxes)
    lost = (what >= share) & (what < 2 * share)
    return replace(flat, boxes=boxes.clamp(0, 1), visible=flat.visible & ~lost)


def spoil_poses(flat: FlatViews, degrees: float, metres: float, seed: int) -> FlatViews:
    """Turn each camera about a random axis and move it, by normally distributed amounts."""
    generator = torch.Generator().manual_seed(seed)
    count = len(flat.world_to_camera)
    turn = torch.randn(count, 3, generator=generator) * (degrees * torch.pi / 180 / 3**0.5)
    x, y, z = turn.unbind(1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    motion = torch.eye(4).repeat(count, 1, 1)
    motion[:, :3, :3] = torch.linalg.matrix_exp(skew)
    motion[:, :3, 3] = torch.randn(count, 3, generator=generator) * (metres / 3**0.5)
    return replace(flat, world_to_camera=motion @ flat.world_to_camera)


def train(config: RunConfig, data: ViewDataset) -> TrainedPrior:
    """The layout stage alone, on what is in memory."""
    lightning.seed_everything(config.seed, verbose=False)
    prior = build_prior(config, len(label_set(config.label_set)))
    latents = build_latents(config, len(data))
    module = LayoutStage(prior, latents, config, len(data.flat.world_to_camera))
    trainer = lightning.Trainer(
        max_epochs=config.layout.epochs, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, accelerator="cpu",
        gradient_clip_val=config.layout.clip_gradient or None,
    )  # fmt: skip
    trainer.fit(module, make_loader(data, config.layout.batch_size, config.seed, 0))
    prior = prior.eval().requires_grad_(False)
    return TrainedPrior(prior, latents.weight.detach(), data.room_ids, config, "layout")


def row(name: str, config: RunConfig, rooms: int, masks: float, poses: bool) -> None:
    folder = Path(config.data.shards)
    data = ViewDataset(folder, "train", config.data.views_per_room, seed=config.seed, limit=rooms)
    if masks:
        data.flat = spoil_masks(data.flat, masks, config.seed + 10)
    if poses:
        data.flat = spoil_poses(data.flat, 2.0, 0.05, config.seed + 11)
    start = time.process_time()
    trained = train(config, data)
    seconds = time.process_time() - start
    truth = reference_scenes(folder, "train", rooms, tracked_only=True)
    decoded = decode_training_rooms(trained)
    scores = reconstruction_scores(list(zip(decoded, truth, strict=True)))
    new = synthesize(trained, 500, 0)
    print(
        f"| {name} | {config.seed} | {scores['box_iou_3d']:.3f} | {scores['class_accuracy']:.3f} "
        f"| {overlap_pairs(truth).per_room:.2f} | {overlap_pairs(decoded).per_room:.2f} "
        f"| {overlap_pairs(new).per_room:.2f} | {category_kl(new, truth):.4f} "
        f"| {object_counts(new).mean():.2f} | {seconds:.0f} |",
        flush=True,
    )
