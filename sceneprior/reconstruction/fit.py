"""Fit latents to the masks of single images, with the network frozen (section 5.2)."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.errors import InputError
from sceneprior.losses.matching import Matches
from sceneprior.losses.shape import mask_loss
from sceneprior.reconstruction.image import rows_of
from sceneprior.training.method import TrainedPrior
from sceneprior.training.objective import (
    check_finite,
    match_and_score,
    seen_boxes,
    seen_masks,
    weighted_sum,
)
from sceneprior.training.ours import PaperConfig
from sceneprior.training.settings import ShapeConfig
from sceneprior.views import DecodedScenes, SceneViews

CHECK_EVERY = 20
"""Steps after which to find out, each time, which images are done."""
SMOOTHING, EPSILON = 0.99, 1e-8
"""RMSProp's, as in PyTorch."""


@dataclass(frozen=True)
class FitSchedule:
    """How the latents of images are found."""

    steps: int = 1000
    drop_at: int = 500
    """Steps after which the rate is multiplied by `decay`."""
    learning_rate: float = 0.01
    decay: float = 0.1
    masks_from: int = 0
    """Steps before the mask loss joins in."""
    freeze_matching: bool = False
    """Keep the matching from there on."""
    patience: int = 100
    """An image whose score has not fallen by `least_gain` of itself for so many steps goes on at
    the low rate at once, and is done when that happens there. 0 takes every step."""
    least_gain: float = 2e-3


SCHEDULES = {
    "paper": FitSchedule(),
    "released": FitSchedule(steps=2000, drop_at=1200, masks_from=200, freeze_matching=True),
}
"""Supplement D, and the authors' code."""


class ViewLoss(NamedTuple):
    """How well scenes explain their images; one number an image."""

    total: Float[Tensor, " images"]
    """What is minimised: class, box, frustum and mask terms with the run's weights."""
    score: Float[Tensor, " images"]
    """What is compared: the layout terms plus lambda_S * (1 - mean IoU of the masks). The mask
    term itself counts masks that miss as zero, so a worse fit may have the lower total."""
    mask_iou: Float[Tensor, " images"]
    """Mean over an image's masks, soft; 0 where masks are not compared."""
    matches: Matches


class Fit(NamedTuple):
    """What was found for each image."""

    z: Float[Tensor, "images width"]
    scenes: DecodedScenes
    """As many objects as the fullest image has; of an image with n, the first n are the answer."""
    loss: ViewLoss
    steps: Int[Tensor, " images"]
    """Taken until nothing moved."""


def decode_images(
    trained: TrainedPrior,
    points: Float[Tensor, "images width"],
    views: SceneViews,
    with_grids: bool = True,
) -> DecodedScenes:
    """As many objects of each latent as the fullest image shows; shapes after the shape stage.

    Without `with_grids` these are meshes alone: looks of occupancy grids are compared with no mask.
    """
    z = trained.prior.latent_space.onto(points)
    with_shape = trained.stage != "layout" and (with_grids or trained.prior.faces is not None)
    return trained.prior.decode(z, with_shape, wanted=views.is_object)


def view_loss(
    trained: TrainedPrior,
    scenes: DecodedScenes,
    views: SceneViews,
    masks: bool = True,
    matches: Matches | None = None,
) -> ViewLoss:
    """The losses of training, per image (a room of `views`) and without completeness.

    Args:
        scenes: At least as many objects a room as the fullest image shows. Those without meshes
            (before the shape stage, or with occupancy grids) have no masks.
        masks: Whether masks are compared; `views` needs instance ids then.
        matches: To keep; None matches anew.
    """
    config = trained.config
    assert isinstance(config, PaperConfig), "a run that remembers rooms has a view loss"
    boxes = seen_boxes(scenes, views, config.shape)
    losses, matches = match_and_score(
        scenes, boxes, views, config.loss, config.model.completeness_target, True, matches
    )
    # An image does not tell how many objects there are beside those that it shows (supplement D).
    del losses["completeness"]
    total = weighted_sum(losses, config.loss)
    faces = trained.prior.faces
    if not masks or scenes.vertices_m is None or faces is None:
        return ViewLoss(total, total.detach(), torch.zeros_like(total), matches)
    layout = total.detach()
    # Before rendering, which refuses vertices that are not finite and knows no images.
    check_finite(layout.sum(), views)
    assert isinstance(config.shape, ShapeConfig), "meshes are learnt from masks"
    seen = seen_masks(scenes.vertices_m, faces, views, config.shape)
    mask, overlap = mask_loss(seen, views, matches, config.loss.iou_gate, per_room=True)
    score = layout + config.loss.mask * (1 - overlap["mask_iou"])
    return ViewLoss(total + config.loss.mask * mask, score, overlap["mask_iou"], matches)


def fit_latents(
    trained: TrainedPrior,
    views: SceneViews,
    start: Float[Tensor, "images width"],
    schedule: FitSchedule = SCHEDULES["paper"],
    masks: bool = True,
) -> Fit:
    """Fit one latent per image by RMSProp on its view loss; the best on the way is the answer.

    Where shapes are occupancy grids, classes and 2D boxes alone are fitted: masks of grids are not
    drawn.

    What moves is z itself, put back onto the sphere before it is decoded, rather than the logits
    that training moves: those reach only what is between the anchors, and reach it slowly.
    RMSProp's first steps are ten times the later ones and leave the start behind; shorter ones,
    and the logits, end worse (docs/experiments/2026-11-22-one-image.md).

    Images do not know of each other: alone or among others, one takes the same steps, but for
    rounding, which grows over a thousand of them.

    Raises:
        InputError: an image shows more objects than the prior can generate.
        FloatingPointError: a loss is not a number.
    """
    refuse_crowds(trained, views)
    points, square = start.detach().clone(), torch.zeros_like(start)
    best, found = torch.full((len(start),), torch.inf), start.detach().clone()
    rate = torch.full((len(start), 1), schedule.learning_rate)
    stalled = torch.zeros(len(start), dtype=torch.int64)
    taken = torch.full((len(start),), schedule.steps)
    active, seen, matches = torch.arange(len(start)), views, None
    for step in range(schedule.steps):
        if step == schedule.drop_at:
            rate = rate.clamp(max=schedule.learning_rate * schedule.decay)
        if step == schedule.masks_from:
            best.fill_(torch.inf)  # scores with and without masks do not compare
        x = points[active].requires_grad_()
        kept = matches if schedule.freeze_matching and step > schedule.masks_from else None
        scenes = decode_images(trained, x, seen, with_grids=False)
        with_masks = masks and step >= schedule.masks_from
        loss = view_loss(trained, scenes, seen, with_masks, kept)
        check_finite(loss.total.sum(), seen)
        matches = loss.matches
        gains = loss.score < best[active] * (1 - schedule.least_gain)
        stalled[active] = torch.where(gains, 0, stalled[active] + 1)
        better = active[loss.score < best[active]]
        found[better] = points[better]
        best[active] = torch.minimum(best[active], loss.score)
        (slope,) = torch.autograd.grad(loss.total.sum(), x)
        square[active] = SMOOTHING * square[active] + (1 - SMOOTHING) * slope**2
        points[active] -= rate[active] * slope / (square[active].sqrt() + EPSILON)
        if schedule.patience and (step + 1) % CHECK_EVERY == 0 and step >= schedule.masks_from:
            still = (stalled >= schedule.patience)[active]
            slow = rate[active, 0] < schedule.learning_rate
            rate[active[still]] = schedule.learning_rate * schedule.decay
            stalled[active[still]] = 0
            taken[active[still & slow]] = step + 1
            going = ~(still & slow)
            if not going.any():
                break
            if not going.all():
                active, seen = active[going], rows_of(seen, going)
                most = seen.is_object.shape[1]
                matches = Matches(*(part[going, :most] for part in matches))
    with torch.no_grad():
        scenes = decode_images(trained, found, views)
        loss = view_loss(trained, scenes, views, masks)
        return Fit(trained.prior.latent_space.onto(found), scenes, loss, taken)


def refuse_crowds(trained: TrainedPrior, views: SceneViews) -> None:
    """Raise an `InputError` where an image shows more objects than the prior can generate."""
    count, row = (int(value) for value in views.is_object.sum(dim=-1).max(dim=0))
    if count > trained.prior.max_objects:
        raise InputError(
            f"{views.room_ids[row]} shows {count} objects, but the run generates at most "
            f"{trained.prior.max_objects} (model.max_objects); leave out the smallest masks, or "
            "train with more."
        )
