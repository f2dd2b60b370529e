"""The GAN's discriminator, and the losses of both networks.

Generator and discriminator minimise `adversarial_loss`. The other losses keep the generator where
the discriminator gives it no useful gradient; docs/baselines_2d.md describes training without each.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import spectral_norm

from sceneprior.core.cameras import camera_centers
from sceneprior.core.classes import VOID
from sceneprior.core.errors import InputError
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.decoders import mlp

SLOPE = 0.2
"""Slope of the leaky ReLUs."""

SMALLEST_PX = 4
"""Minimum side of a map; halving it twice leaves one pixel."""

GAIN = 10
"""Factor on all scores, which spectral normalisation makes small."""


class MapDiscriminator(nn.Module):
    """Scores each patch of 18 x 18 pixels of a map, and each room by all of its views.

    Every layer is spectrally normalised, so that the network is about 1-Lipschitz. There is no
    depth channel (supplement, Baselines). Two layers halve the sides; the first has `width`
    channels, the second twice as many.
    """

    def __init__(self, classes: int, width: int = 32):
        super().__init__()
        self.layers = _bounded(
            nn.Conv2d(classes, width, 4, stride=2, padding=1),
            nn.Conv2d(width, 2 * width, 4, stride=2, padding=1),
        )
        self.patch = _bounded(nn.Conv2d(2 * width, 1, 3, padding=1))
        self.room = _bounded(nn.Linear(4 * width, 2 * width), nn.Linear(2 * width, 1))

    def forward(
        self, maps: Float[Tensor, "rooms views classes height width"]
    ) -> tuple[Float[Tensor, "rooms views rows columns"], Float[Tensor, " rooms"]]:
        """Scores of patches and of rooms; higher means more real.

        A room's features are the mean and the maximum over its views, so the order and number of
        views do not matter.
        """
        height, width = maps.shape[-2:]
        if min(height, width) < SMALLEST_PX:
            raise InputError(
                f"Semantic maps of {height} x {width} pixels are too small for the GAN, which "
                f"needs {SMALLEST_PX} x {SMALLEST_PX}; lower data.mask_step, or prepare larger "
                "images."
            )
        x = F.leaky_relu(self.layers(maps.flatten(0, 1)), SLOPE)
        patches = self.patch(x)[:, 0].unflatten(0, maps.shape[:2])
        features = x.mean(dim=(2, 3)).unflatten(0, maps.shape[:2])
        room = torch.cat([features.mean(dim=1), features.amax(dim=1)], dim=-1)
        return GAIN * patches, GAIN * self.room(room)[:, 0]


def _bounded(*layers: nn.Module) -> nn.Sequential:
    return mlp(*(spectral_norm(layer) for layer in layers), slope=SLOPE)


VARIED = (1.5, 1.5, 0.3, 0.3, 0.3)
"""Target standard deviation over rooms, in metres, of the k-th object's x, z, width, height and
depth."""

AREA = 10
"""Factor on the pixel shares in `contents`, because such a share is only a few hundredths."""

MARGIN_M, CEILING_M = 0.5, 3.0
"""Bounds of generated boxes in metres. Along x and z, they are `MARGIN_M` beyond the batch's
furthest camera from the floor centre; along y, they are the floor and `CEILING_M`."""

SIZES_M = (0.1, 2.5)
"""Bounds of generated sizes in metres."""


def adversarial_loss(scores: Sequence[Tensor], real: bool) -> Float[Tensor, ""]:
    """Cross entropy of scores as logits of being real, summed over patches and rooms.

    The generator minimises it with `real` true for its own maps: the non-saturating loss of
    Goodfellow et al., "Generative adversarial nets", NeurIPS 2014.
    """
    return torch.stack([F.softplus(-score if real else score).mean() for score in scores]).sum()


def contents(
    maps: Float[Tensor, "rooms views classes height width"], counts: Float[Tensor, "rooms classes"]
) -> Float[Tensor, "rooms both"]:
    """For each class, the number of objects in a room, and `AREA` times the class's share of the
    pixels of all views."""
    return torch.cat([counts, AREA * maps.mean(dim=(1, 3, 4))], dim=-1)


def bounds_penalty(scenes: DecodedScenes, views: SceneViews) -> Float[Tensor, ""]:
    """Mean distance in metres by which boxes exceed the room's bounds and sizes exceed `SIZES_M`.

    In a map, a bed looks the same as a huge bed behind the room. Objects that no view shows get no
    other gradient, so without this penalty they would not return to the room.
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
    """Mean square of the completeness logits, plus that of the class logits except `void`."""
    classes = scenes.class_logits[..., VOID + 1 :]
    return classes.square().mean() + scenes.completeness_logits.square().mean()


def diversity_loss(scenes: DecodedScenes) -> Float[Tensor, ""]:
    """Minus the mean log of the standard deviation of the k-th object's position and size over
    rooms, relative to `VARIED`.

    Up to a constant, this is minus the entropy of normal distributions with these deviations (after
    Kumar et al., "Maximum entropy generators for energy-based models", 2019). A deviation is at
    least about 1 mm, and it is not rewarded beyond `VARIED`, because that would drive objects out
    of the room.
    """
    boxes = torch.cat([scenes.centers_m[..., [0, 2]], scenes.sizes_m], dim=-1)
    wanted = boxes.new_tensor(VARIED).square()
    return -((boxes.var(dim=0, correction=0) + 1e-6) / wanted).clamp(max=1).log().mean() / 2
