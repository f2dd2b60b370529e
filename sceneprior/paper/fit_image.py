"""Fit latents to the masks of single images, with the network frozen (section 5.2)."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.errors import InputError
from sceneprior.core.views import DecodedScenes, SceneViews, rows_of
from sceneprior.paper.config import PaperConfig
from sceneprior.paper.losses import layout_losses, mask_loss, seen_masks
from sceneprior.paper.matching import Matches, seen_boxes
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.settings import LossConfig, ShapeConfig
from sceneprior.training.steps import check_finite, weighted_sum

CHECK_EVERY = 20
"""Steps between two checks of which images have converged."""
SMOOTHING, EPSILON = 0.99, 1e-8
"""RMSProp's smoothing constant and epsilon: the defaults of PyTorch."""


@dataclass(frozen=True)
class FitSchedule:
    """Step count, learning rates and stopping rule for fitting the latents of images."""

    steps: int = 1000
    drop_at: int = 500
    """Step at which the learning rate is multiplied by `decay`."""
    learning_rate: float = 0.01
    decay: float = 0.1
    patience: int = 100
    """Number of steps without progress after which an image counts as stalled. A stalled image
    continues at the decayed learning rate, and is done when it stalls at that rate. 0 always takes
    all steps."""
    least_gain: float = 2e-3
    """Smallest relative decrease of the score that counts as progress; see `patience`."""


SCHEDULES = {"paper": FitSchedule()}
"""Schedules by name; `paper` is that of supplement D."""


class ViewLoss(NamedTuple):
    """View loss of scenes on their images, one number per image."""

    total: Float[Tensor, " images"]
    """The loss that is minimised: class, box, frustum and mask terms with the run's weights."""
    score: Float[Tensor, " images"]
    """The score that ranks fits: the layout terms plus lambda_S * (1 - mean IoU of the masks). The
    mask term itself counts badly aligned masks as zero, so a worse fit may have the lower
    `total`."""
    mask_iou: Float[Tensor, " images"]
    """Mean soft IoU over an image's masks; 0 where masks are not compared."""
    matches: Matches


class Fit(NamedTuple):
    """The best latent and scene found for each image."""

    z: Float[Tensor, "images width"]
    scenes: DecodedScenes
    """The decoded scenes, with as many predictions as the fullest image has objects. For an image
    of n objects, the first n predictions are the reconstruction."""
    loss: ViewLoss
    steps: Int[Tensor, " images"]
    """Number of steps until the image converged."""


def decode_images(
    trained: TrainedPrior,
    points: Float[Tensor, "images width"],
    views: SceneViews,
    with_shapes: bool = True,
) -> DecodedScenes:
    """Decode from each latent as many objects as the fullest image shows.

    Shapes are decoded, too, unless the run has only trained its layout stage. If `with_shapes` is
    false, only meshes are decoded: other shapes are not compared with masks.
    """
    z = trained.prior.latent_space.onto(points)
    with_shape = trained.stage != "layout" and (
        with_shapes or trained.prior.shape.faces is not None
    )
    return trained.prior.decode(z, with_shape, wanted=views.is_object)


def view_loss(
    trained: TrainedPrior,
    scenes: DecodedScenes,
    views: SceneViews,
    masks: bool = True,
) -> ViewLoss:
    """The losses of training, but one value per image (a room of `views`), without completeness.

    `scenes` have at least as many objects as the fullest image shows. If `masks` is true, rendered
    masks are compared as well, which needs instance ids in `views`, and objects with meshes.
    """
    config = trained.config
    weights, stage = LossConfig(), ShapeConfig(epochs=1)  # the paper's, for runs without views
    if isinstance(config, PaperConfig):
        weights, stage = config.loss, config.shape
    boxes = seen_boxes(scenes, views, stage.proxy, stage.box_from)
    losses, matches = layout_losses(scenes, boxes, views, weights, None)
    total = weighted_sum(losses, weights)
    layout, faces = total.detach(), trained.prior.shape.faces
    if not masks or scenes.vertices_m is None or faces is None:
        return ViewLoss(total, layout, torch.zeros_like(total), matches)
    seen = seen_masks(scenes.vertices_m, faces, views, stage)
    mask, overlap = mask_loss(seen, views, matches, weights.iou_gate, per_room=True)
    score = layout + weights.mask * (1 - overlap["mask_iou"])
    return ViewLoss(total + weights.mask * mask, score, overlap["mask_iou"], matches)


def fit_latents_to_images(
    trained: TrainedPrior,
    views: SceneViews,
    start: Float[Tensor, "images width"],
    schedule: FitSchedule,
    masks: bool = True,
) -> Fit:
    """Fit one latent per image with RMSProp on its view loss, and return the best latent found.

    Only deformed meshes are rendered: with other shapes, classes and 2D boxes alone are fitted.

    The fit moves z itself and projects it onto the sphere before each decoding. Training moves the
    logits instead, but logits only reach points between the anchors, and reach them slowly. The
    first steps of RMSProp are ten times as large as later ones and move far from the start; smaller
    first steps, or fitting the logits, give worse results
    (docs/experiments/2026-11-22-one-image.md).

    Images are independent: an image takes the same steps alone as in a batch, apart from rounding
    errors, which grow over a thousand steps.
    """
    refuse_crowds(trained, views)
    points, square = start.detach().clone(), torch.zeros_like(start)
    best, found = torch.full((len(start),), torch.inf), start.detach().clone()
    rate = torch.full((len(start), 1), schedule.learning_rate)
    stalled = torch.zeros(len(start), dtype=torch.int64)
    taken = torch.full((len(start),), schedule.steps)
    active, seen = torch.arange(len(start)), views
    for step in range(schedule.steps):
        if step == schedule.drop_at:
            rate = rate.clamp(max=schedule.learning_rate * schedule.decay)
        x = points[active].requires_grad_()
        scenes = decode_images(trained, x, seen, with_shapes=False)
        loss = view_loss(trained, scenes, seen, masks)
        check_finite(loss.total.sum(), seen.room_ids)
        gains = loss.score < best[active] * (1 - schedule.least_gain)
        stalled[active] = torch.where(gains, 0, stalled[active] + 1)
        better = active[loss.score < best[active]]
        found[better] = points[better]
        best[active] = torch.minimum(best[active], loss.score)
        (slope,) = torch.autograd.grad(loss.total.sum(), x)
        square[active] = SMOOTHING * square[active] + (1 - SMOOTHING) * slope**2
        points[active] -= rate[active] * slope / (square[active].sqrt() + EPSILON)
        if schedule.patience and (step + 1) % CHECK_EVERY == 0:
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
    with torch.no_grad():
        scenes = decode_images(trained, found, views)
        loss = view_loss(trained, scenes, views, masks)
        return Fit(trained.prior.latent_space.onto(found), scenes, loss, taken)


def refuse_crowds(trained: TrainedPrior, views: SceneViews) -> None:
    """Raise an `InputError` if an image shows more objects than the prior can generate."""
    count, row = (int(value) for value in views.is_object.sum(dim=-1).max(dim=0))
    if count > trained.prior.max_objects:
        raise InputError(
            f"{views.room_ids[row]} shows {count} objects, but the run generates at most "
            f"{trained.prior.max_objects} (model.max_objects); leave out the smallest masks, or "
            "train with more."
        )
