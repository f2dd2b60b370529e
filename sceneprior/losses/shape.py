"""Rendered and observed masks of matched objects in, the gated mask loss out (equation 8)."""

from jaxtyping import Float, Integer
from torch import Tensor
from torch.nn import functional as F

from sceneprior.batches import SceneViews
from sceneprior.losses.matching import Matches
from sceneprior.losses.processes import share_of_batch

CERTAIN = 1e-6
"""Pixels of a mask this near to 0 or 1 carry no gradient."""


def mask_loss(
    rendered: Float[Tensor, "rooms views predictions height width"],
    views: SceneViews,
    matches: Matches,
    iou_gate: float = 0.5,
) -> tuple[Float[Tensor, ""], dict[str, Float[Tensor, ""]]]:
    """Binary cross entropy of visible masks, where prediction and observation overlap enough.

    Averaged over pixels, then over an object's views, then over objects; a mask whose IoU with
    its observation is not above `iou_gate` counts as zero, as in the paper.

    Args:
        rendered: Visible soft masks of all predictions.
        views: What the cameras saw, with `instance_ids` of the same height and width.
        matches: Which prediction answers for which object.
        iou_gate: The paper's 0.5.

    Returns:
        The loss, and `mask_iou` (mean over all visible pairs) and `mask_used` (share gated in)
        to log.
    """
    seen = views.visible & matches.valid.unsqueeze(1)
    room, view, item = seen.nonzero(as_tuple=True)
    prediction = matches.prediction[room, item]
    mine = rendered[room, view, prediction]
    observed = (observed_ids(views)[room, view] == (item + 1)[:, None, None]).to(mine.dtype)
    iou = soft_iou(mine.detach(), observed)
    use = (iou > iou_gate).to(mine.dtype)
    # Where a wrong mask rounds to 0 or 1, the gradient of log would be torch's 1e12.
    certain = mine.clamp(CERTAIN, 1 - CERTAIN)
    each = F.binary_cross_entropy(certain, observed, reduction="none").mean(dim=(1, 2))
    count = seen.sum(dim=1)
    share = 1 / count[room, item].to(mine.dtype)
    objects = (count > 0).sum()
    loss = (each * use * share).sum() / objects.clamp(min=1) * share_of_batch(objects)
    pairs = max(len(room), 1)
    return loss, {"mask_iou": iou.sum() / pairs, "mask_used": use.sum() / pairs}


def soft_iou(
    a: Float[Tensor, "pairs height width"], b: Float[Tensor, "pairs height width"]
) -> Float[Tensor, " pairs"]:
    """Intersection over union of soft masks; two empty masks have 0."""
    both = (a * b).sum(dim=(1, 2))
    return both / (a.sum(dim=(1, 2)) + b.sum(dim=(1, 2)) - both).clamp(min=1e-6)


def observed_ids(views: SceneViews) -> Integer[Tensor, "rooms views height width"]:
    """The views' instance-id images.

    Raises:
        ValueError: the views were loaded without them.
    """
    if views.instance_ids is None:
        raise ValueError("mask_loss needs views with instance_ids; load the data with a mask_step")
    return views.instance_ids
