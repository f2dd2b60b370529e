"""Losses of the GAN: the adversarial one, and penalties and aims of the generator.

`adversarial_loss` is what both players minimise. The others are what a discriminator of maps does
not say, or says too late; docs/baselines_2d.md tells what happens without each.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional as F

from sceneprior.classes import VOID
from sceneprior.geometry.cameras import camera_centers
from sceneprior.views import DecodedScenes, SceneViews

VARIED = (1.5, 1.5, 0.3, 0.3, 0.3)
"""Spread over rooms, in metres, that the k-th object's x, z, width, height and depth are pushed
towards."""

AREA = 10
"""As how many objects of a class it counts if all pixels are of it: shares are a few hundredths."""

MARGIN_M, CEILING_M = 0.5, 3.0
"""Generated boxes are to stay no further from the floor centre, along x and z, than some camera of
the batch and a margin, and between floor and ceiling."""

SIZES_M = (0.1, 2.5)
"""What generated sizes are to stay between."""


def adversarial_loss(scores: Sequence[Tensor], real: bool) -> Float[Tensor, ""]:
    """Cross entropy of scores, as logits of being real, with what is wanted of them.

    Patches and rooms count alike. The generator minimises it for its own maps as if these were
    real (Goodfellow et al., "Generative adversarial nets", NeurIPS 2014: the loss that does not
    saturate).
    """
    return torch.stack([F.softplus(-score if real else score).mean() for score in scores]).sum()


def contents(
    maps: Float[Tensor, "rooms views classes height width"], counts: Float[Tensor, "rooms classes"]
) -> Float[Tensor, "rooms both"]:
    """What is in a room: how many objects of each class, and `AREA` times their share of views."""
    return torch.cat([counts, AREA * maps.mean(dim=(1, 3, 4))], dim=-1)


def bounds_penalty(scenes: DecodedScenes, views: SceneViews) -> Float[Tensor, ""]:
    """How far boxes reach out of where cameras go, and sizes out of `SIZES_M`, in metres: a mean.

    A discriminator of maps cannot tell a bed from a bed-coloured wall behind the room, and what no
    view shows has no part in any map: unless it is told to come back, it goes for ever.
    """
    reach = camera_centers(views.world_to_camera).abs().amax(dim=(0, 1)) + MARGIN_M
    reach[1] = CEILING_M / 2
    aside = scenes.centers_m - reach.new_tensor([0, CEILING_M / 2, 0])
    smallest, largest = SIZES_M
    outside = (
        F.relu(aside.abs() + scenes.sizes_m / 2 - reach),
        F.relu(smallest - scenes.sizes_m),
        F.relu(scenes.sizes_m - largest),
    )
    return torch.stack(outside).mean()


def logit_penalty(scenes: DecodedScenes) -> Float[Tensor, ""]:
    """Mean squares of the logits that decide: 0 is undecided. `void` is no choice."""
    classes = scenes.class_logits[..., VOID + 1 :]
    return classes.square().mean() + scenes.completeness_logits.square().mean()


def diversity_loss(scenes: DecodedScenes) -> Float[Tensor, ""]:
    """How alike the k-th objects of all rooms are: minus the mean log spread of place and size, as
    a share of `VARIED`.

    It is minus the entropy of normal distributions of their spread (after Kumar et al., "Maximum
    entropy generators for energy-based models", 2019). Below 1 mm a spread counts as 1 mm; above
    `VARIED` there is nothing to gain, or objects would leave the room for the sake of it.
    """
    boxes = torch.cat([scenes.centers_m[..., [0, 2]], scenes.sizes_m], dim=-1)
    wanted = boxes.new_tensor(VARIED).square()
    return -((boxes.var(dim=0, correction=0) + 1e-6) / wanted).clamp(max=1).log().mean() / 2
