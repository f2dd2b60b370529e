"""Decoded scenes and what cameras saw in, weighted losses out: the part both stages share."""

import lightning
import numpy as np
import torch
from jaxtyping import Float, Int
from lightning.pytorch.utilities.types import OptimizerLRSchedulerConfig
from torch import Tensor, nn
from torch import distributed as dist

from sceneprior.config import LossConfig, RunConfig, ShapeConfig, StageConfig
from sceneprior.geometry.boxes import beveled_cube, place
from sceneprior.geometry.cameras import Boxes2D, boxes_of_points
from sceneprior.geometry.corners import box_corners
from sceneprior.geometry.ellipsoids import boxes_of_ellipsoids
from sceneprior.geometry.meshes import icosphere
from sceneprior.losses.layout import layout_losses
from sceneprior.losses.matching import Matches, match_objects
from sceneprior.losses.shape import observed_ids
from sceneprior.models.prior import ScenePrior
from sceneprior.silhouettes.render import render_silhouettes
from sceneprior.views import DecodedScenes, RoomBoxes, SceneViews

POINTS_LEVEL = 2
"""`ellipsoid_points` are 162: spheres 0.6% too small, 1.7% in the worst direction."""


def proxy_boxes(scenes: DecodedScenes, views: SceneViews, proxy: str) -> Boxes2D:
    """2D boxes of objects that have no mesh yet; `StageConfig.proxy` says what each stands for."""
    centers_m, sizes_m = scenes.centers_m, scenes.sizes_m
    cameras, intrinsics = views.world_to_camera, views.intrinsics
    if proxy == "ellipsoid":
        return boxes_of_ellipsoids(centers_m, sizes_m, cameras, intrinsics, views.image_size)
    if proxy == "box":
        points_m = box_corners(centers_m, sizes_m)
    elif proxy == "beveled_box":
        assert scenes.bevels is not None, "decode() gives every object bevels"
        points_m = place(beveled_cube(scenes.bevels), centers_m, sizes_m)
    else:
        sphere = icosphere(POINTS_LEVEL)[0].to(centers_m)
        points_m = place(sphere.expand(*centers_m.shape[:2], -1, -1), centers_m, sizes_m)
    return boxes_of_points(points_m, cameras, intrinsics, views.image_size)


def match_and_score(
    scenes: DecodedScenes,
    boxes: Boxes2D,
    views: SceneViews,
    weights: LossConfig,
    per_room: bool = False,
    matches: Matches | None = None,
) -> tuple[dict[str, Float[Tensor, "*rooms"]], Matches]:
    """Match predictions to tracked objects by their 2D boxes and take the layout losses.

    Args:
        scenes, boxes: Predictions, and where the views would see them.
        views: What the cameras saw.
        weights: Of the run.
        per_room: Losses of each room alone.
        matches: To keep; None matches anew.
    """
    if matches is None:
        matches = match_objects(scenes, boxes, views, weights.match_box, weights.occlusion_slack)
    losses = layout_losses(
        scenes, boxes, views, matches, weights.occlusion_slack, weights.completeness_target,
        per_room,
    )  # fmt: skip
    return losses, matches


def seen_boxes(scenes: DecodedScenes, views: SceneViews, settings: ShapeConfig) -> Boxes2D:
    """2D boxes of decoded objects: of their meshes where there are any (`ShapeConfig.box_from`)."""
    if settings.box_from == "proxy" or scenes.vertices_m is None:
        return proxy_boxes(scenes, views, settings.proxy)
    return boxes_of_points(
        scenes.vertices_m, views.world_to_camera, views.intrinsics, views.image_size
    )


def seen_masks(
    vertices_m: Float[Tensor, "rooms objects vertices 3"],
    faces: Int[Tensor, "faces 3"],
    views: SceneViews,
    settings: ShapeConfig,
) -> Float[Tensor, "rooms views objects height width"]:
    """Soft visible masks of decoded objects, at the size of the views' instance ids.

    Only the first n predictions of a room of n objects are drawn: they answer for objects, and
    the rest would hide them.
    """
    slots = torch.arange(vertices_m.shape[1], device=vertices_m.device)
    height, width = observed_ids(views).shape[-2:]
    return render_silhouettes(
        vertices_m,
        faces,
        views.world_to_camera,
        views.intrinsics_at(height, width),
        (height, width),
        sigma_px2=settings.sigma_px2,
        mode=settings.silhouettes,
        compositing=settings.compositing,
        drawn=slots < views.is_object.sum(dim=-1, keepdim=True),
    )


def weighted_sum(
    losses: dict[str, Float[Tensor, "*rooms"]], weights: LossConfig
) -> Float[Tensor, "*rooms"]:
    """The total that is minimised: one number, or one a room."""
    by_name = weights.model_dump(by_alias=True)
    return torch.stack([by_name[name] * loss for name, loss in losses.items()]).sum(dim=0)


def check_finite(total: Tensor, views: SceneViews | RoomBoxes) -> None:
    """Stop at the first loss that is not a number, and name the rooms that made it.

    Several processes stop together: one that stopped alone would leave the others waiting.

    Raises:
        FloatingPointError: the loss is NaN or infinite, here or in another process.
    """
    finite = torch.isfinite(total.detach())
    several = dist.is_available() and dist.is_initialized()
    if several:
        worst = finite.to(torch.int32)
        dist.all_reduce(worst, dist.ReduceOp.MIN)
        all_finite = bool(worst)
    else:
        all_finite = bool(finite)
    if all_finite:
        return
    told = [(total.item(), () if finite else views.room_ids)]
    if several:
        told = [told[0]] * dist.get_world_size()
        dist.all_gather_object(told, (total.item(), () if finite else views.room_ids))
    value = next(value for value, rooms in told if rooms)
    raise FloatingPointError(
        f"The loss is {value} on rooms {', '.join(room for _, rooms in told for room in rooms)}; "
        "lower the learning rate, or look at these rooms with `sceneprior inspect`."
    )


def full_precision(device: torch.device) -> torch.autocast:
    """Where mixed precision ends: networks may run in half the bits; latents, projections,
    matching, silhouettes and losses may not."""
    return torch.autocast(device.type, enabled=False)


def build_prior(config: RunConfig, classes: int) -> ScenePrior:
    """The network a config describes, freshly initialised from its seed."""
    torch.manual_seed(config.seed)
    # A GAN's objects are never void: see docs/baselines_2d.md.
    void = config.stages != "gan"
    return ScenePrior(classes=classes, void=void, seed=config.seed, **config.model.model_dump())


def build_latents(config: RunConfig, rooms: int) -> nn.Embedding:
    """One row of latent logits a training room, drawn from N(0, 1)."""
    generator = torch.Generator().manual_seed(config.seed + 1)
    logits = torch.randn(rooms, config.model.logits_per_room, generator=generator)
    return nn.Embedding.from_pretrained(logits, freeze=False)


def batch_number(trainer: lightning.Trainer, batch_idx: int) -> int:
    """How many batches came before this one; `accumulate` makes several of them one step."""
    return trainer.current_epoch * int(trainer.num_training_batches) + batch_idx


def step_seed(seed: int, batch: int, rank: int) -> int:
    """A seed of its own for each batch and process, the same when a run is resumed."""
    return int(np.random.SeedSequence([seed, batch, rank]).generate_state(1, np.uint64)[0] >> 1)


def training_latents(
    prior: ScenePrior,
    latents: nn.Embedding,
    rows: Int[Tensor, " rooms"],
    stage: StageConfig,
    progress: float,
    seed: int,
) -> Float[Tensor, "rooms width"]:
    """The rooms' points of the latent space, moved a little where the stage asks for it.

    Args:
        prior, latents: Of the run.
        rows: Which rooms.
        stage: Says how far to move.
        progress: Share of the stage that is done, 0 to 1.
        seed: Of this step's noise.
    """
    end = stage.latent_noise if stage.latent_noise_end is None else stage.latent_noise_end
    noise = stage.latent_noise + progress * (end - stage.latent_noise)
    with full_precision(rows.device):
        z = prior.latent_space(latents(rows))
        return prior.latent_space.step(z, noise, seed) if noise else z


def build_optimizer(
    prior: ScenePrior, latents: nn.Embedding, stage: StageConfig, steps: int
) -> OptimizerLRSchedulerConfig:
    """Adam with the stage's schedule over `steps` updates, in the shape Lightning takes."""
    fresh = list(prior.shape.parameters())
    tables = [*latents.parameters(), *prior.bevels.parameters()]
    others = ("shape.", "bevels.")
    trained = [item for name, item in prior.named_parameters() if not name.startswith(others)]
    fresh_rate = getattr(stage, "decoder_learning_rate", None) or stage.learning_rate
    groups = [
        {"params": trained, "lr": stage.learning_rate},
        {"params": fresh, "lr": fresh_rate},
        {"params": tables, "lr": stage.latent_learning_rate},
    ]
    optimizer = torch.optim.Adam(groups, fused=True)
    if stage.schedule == "cosine":
        rates = [group["lr"] for group in optimizer.param_groups]
        rise = torch.optim.lr_scheduler.OneCycleLR(
            optimizer, rates, total_steps=steps + 1, pct_start=0.05, cycle_momentum=False
        )
        return {"optimizer": optimizer, "lr_scheduler": {"scheduler": rise, "interval": "step"}}
    drops = torch.optim.lr_scheduler.MultiStepLR(
        optimizer, list(stage.milestones), gamma=stage.decay
    )
    return {"optimizer": optimizer, "lr_scheduler": drops}
