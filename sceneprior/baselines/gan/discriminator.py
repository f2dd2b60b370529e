"""The GAN's discriminator: how real each patch of a map, and each room, looks."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import spectral_norm

from sceneprior.errors import InputError
from sceneprior.models.layers import mlp

SLOPE = 0.2
"""Of the leaky ReLUs."""

SMALLEST_PX = 4
"""Side of a map that two halvings leave a pixel of."""

GAIN = 10
"""Of all scores: spectral norm makes them timid."""


class MapDiscriminator(nn.Module):
    """Scores maps patch by patch, and a room by all of its views together.

    Every layer is spectrally normalised, so that the network is about 1-Lipschitz. There is no
    depth channel (supplement, Baselines). Two layers halve the sides; the first has `width`
    channels, the second twice as many. A patch is then 18 x 18 pixels of a map.
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
        """Scores of patches and of rooms; a higher score looks more real.

        A room is what its views show on average and at most, whatever their order and number.

        Raises:
            InputError: the maps are smaller than `SMALLEST_PX`.
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
