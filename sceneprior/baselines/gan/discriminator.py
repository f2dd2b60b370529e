"""The GAN's discriminator, which scores patches of semantic maps and whole rooms."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import spectral_norm

from sceneprior.core.errors import InputError
from sceneprior.paper.layers import mlp

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
