"""The view loss of decoded scenes; seeds, precision, checks and schedules of all methods."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch import distributed as dist
from torch.nn import functional as F

from sceneprior.geometry.cameras import Boxes2D, boxes_of_points
from sceneprior.geometry.corners import box_corners
from sceneprior.geometry.ellipsoids import boxes_of_ellipsoids
from sceneprior.geometry.meshes import beveled_cube, icosphere, place
from sceneprior.losses.layout import layout_losses
from sceneprior.losses.matching import Matches, match_objects
from sceneprior.silhouettes.render import render_silhouettes
from sceneprior.training.settings import LiftedShapeConfig, LossConfig, ShapeConfig
from sceneprior.views import DecodedScenes, LiftedRooms, RoomBoxes, SceneViews

if TYPE_CHECKING:  # Lightning takes longer to import than all else that loads a prior
    import lightning.pytorch.utilities.types

POINTS_LEVEL = 2
"""`ellipsoid_points` are 162: spheres 0.6% too small, 1.7% in the worst direction."""


def proxy_boxes(scenes: DecodedScenes, views: SceneViews, proxy: str) -> Boxes2D:
    """2D boxes of objects that have no mesh yet; `StageConfig.proxy` says what each stands for.

    Of a room with n tracked objects, the first n predictions', as in `seen_boxes`.
    """
    objects = (scenes.centers_m, scenes.sizes_m)
    if proxy == "ellipsoid":
        return _of_first(boxes_of_ellipsoids, views, *objects)
    if proxy == "box":
        points_m = box_corners(*objects)
    elif proxy == "beveled_box":
        assert scenes.bevels is not None, "decode() gives every object bevels"
        points_m = place(beveled_cube(scenes.bevels), *objects)
    else:
        sphere = icosphere(POINTS_LEVEL)[0].to(scenes.centers_m)
        points_m = place(sphere.expand(*scenes.centers_m.shape[:2], -1, -1), *objects)
    return _of_first(boxes_of_points, views, points_m)


def first_predictions(views: SceneViews, slots: int) -> Bool[Tensor, "rooms slots"]:
    """The first n of each room of n tracked objects, to which alone objects are matched."""
    return F.pad(views.is_object, (0, slots - views.is_object.shape[1]))


def _of_first(project: Callable[..., Boxes2D], views: SceneViews, *objects: Tensor) -> Boxes2D:
    """`project` the first predictions alone; the others have empty boxes outside of the frustum."""
    rooms, slots = objects[0].shape[:2]
    first = first_predictions(views, slots)
    room = first.nonzero()[:, 0]
    # Each in a room of its own.
    cameras = (views.world_to_camera[room], views.intrinsics[room], views.image_size)
    boxes, inside = project(*(values[first].unsqueeze(1) for values in objects), *cameras)
    return Boxes2D(*(
        of.new_zeros(rooms, slots, *of.shape[1:2], *of.shape[3:])
        .index_put((first,), of[:, :, 0])
        .transpose(1, 2)
        for of in (boxes, inside)
    ))  # fmt: skip


def match_and_score(
    scenes: DecodedScenes,
    boxes: Boxes2D,
    views: SceneViews,
    weights: LossConfig,
    completeness_target: str,
    per_room: bool = False,
    matches: Matches | None = None,
) -> tuple[dict[str, Float[Tensor, "*rooms"]], Matches]:
    """Match predictions to tracked objects by their 2D boxes `boxes`, unless `matches` are given,
    and take the layout losses: of the batch, or `per_room`."""
    if matches is None:
        matches = match_objects(scenes, boxes, views, weights.match_box, weights.occlusion_slack)
    losses = layout_losses(
        scenes, boxes, views, matches, weights.occlusion_slack, completeness_target, per_room
    )
    return losses, matches


def seen_boxes(
    scenes: DecodedScenes, views: SceneViews, settings: ShapeConfig | LiftedShapeConfig
) -> Boxes2D:
    """2D boxes of decoded objects: of their meshes where there are any (`ShapeConfig.box_from`).

    Of a room with n tracked objects, the first n predictions', which are matched; the boxes of the
    others are empty, and in no frustum.
    """
    if (
        scenes.vertices_m is None
        or isinstance(settings, LiftedShapeConfig)
        or settings.box_from == "proxy"
    ):
        return proxy_boxes(scenes, views, settings.proxy)
    return _of_first(boxes_of_points, views, scenes.vertices_m)


def seen_masks(
    vertices_m: Float[Tensor, "rooms objects vertices 3"],
    faces: Int[Tensor, "faces 3"],
    views: SceneViews,
    settings: ShapeConfig,
) -> Float[Tensor, "rooms views objects height width"]:
    """Soft visible masks of decoded objects, at the size of the views' instance ids.

    Only the first n predictions of a room of n objects are drawn: they are matched to objects,
    and the rest would hide them.
    """
    height, width = views.observed_ids.shape[-2:]
    return render_silhouettes(
        vertices_m,
        faces,
        views.world_to_camera,
        views.intrinsics_at(height, width),
        (height, width),
        sigma_px2=settings.sigma_px2,
        mode=settings.silhouettes,
        compositing=settings.compositing,
        drawn=first_predictions(views, vertices_m.shape[1]),
    )


def weighted_sum(
    losses: dict[str, Float[Tensor, "*rooms"]], weights: LossConfig
) -> Float[Tensor, "*rooms"]:
    """sum_t lambda_t L_t: L_L (Eq. 7), and with the mask term L = L_L + lambda_S L_S.

    One number, or one a room.
    """
    by_name = weights.model_dump(by_alias=True)
    return torch.stack([by_name[name] * loss for name, loss in losses.items()]).sum(dim=0)


def check_finite(total: Tensor, views: SceneViews | LiftedRooms | RoomBoxes) -> None:
    """Stop at the first loss that is not a number, and name the rooms that made it.

    Several processes stop together: one that stopped alone would leave the others waiting.

    Raises:
        FloatingPointError: the loss is NaN or infinite, here or in another process.
    """
    value = total.item()
    finite = math.isfinite(value)
    told = [(value, () if finite else views.room_ids)]
    if dist.is_available() and dist.is_initialized():
        worst = torch.tensor(int(finite), device=total.device)
        dist.all_reduce(worst, dist.ReduceOp.MIN)
        finite = bool(worst)
        if not finite:
            told *= dist.get_world_size()
            dist.all_gather_object(told, told[0])
    if finite:
        return
    value = next((bad for bad, rooms in told if rooms), value)
    raise FloatingPointError(
        f"The loss is {value} on rooms {', '.join(room for _, rooms in told for room in rooms)}; "
        "lower the learning rate, or look at these rooms with `sceneprior inspect`."
    )


def full_precision(device: torch.device) -> torch.autocast:
    """Where mixed precision ends: networks may run in half the bits; latents, projections,
    matching, silhouettes and losses may not."""
    return torch.autocast(device.type, enabled=False)


def batch_seed(seed: int, trainer: "lightning.Trainer", batch_idx: int) -> int:
    """A seed of its own for each batch and process, the same when a run is resumed."""
    batch = trainer.current_epoch * int(trainer.num_training_batches) + batch_idx
    sequence = np.random.SeedSequence([seed, batch, trainer.global_rank])
    return int(sequence.generate_state(1, np.uint64)[0] >> 1)


def log_losses(
    module: "lightning.LightningModule", values: dict[str, Tensor], total: Tensor, rooms: int
) -> None:
    """Log means over an epoch and all processes, as `train/<name>` and `train/loss`."""
    named = {f"train/{name}": value.detach() for name, value in (values | {"loss": total}).items()}
    module.log_dict(named, on_step=False, on_epoch=True, batch_size=rooms, sync_dist=True)


def with_cosine(
    optimizer: torch.optim.Optimizer, steps: int
) -> "lightning.pytorch.utilities.types.OptimizerLRSchedulerConfig":
    """The optimiser with rates that rise for a twentieth of `steps`, then fall to 0 by a cosine."""
    rise = torch.optim.lr_scheduler.OneCycleLR(
        optimizer,
        [group["lr"] for group in optimizer.param_groups],
        total_steps=steps + 1,
        pct_start=0.05,
        cycle_momentum=False,
    )
    return {"optimizer": optimizer, "lr_scheduler": {"scheduler": rise, "interval": "step"}}
