"""Semantic maps of rooms in, how real each patch, and each room, looks out: the GAN's opponent."""

import itertools

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import spectral_norm

STEPS = 2
"""Halvings of a map's sides; a patch is then 18 x 18 pixels of it."""

GAIN = 10
"""Of all scores: at 1, one object more or less would move the odds by e at most."""


class MapDiscriminator(nn.Module):
    """Judge maps patch by patch, and a room by all of its views together.

    Every layer is spectrally normalised, so that the network is about 1-Lipschitz. There is no
    depth channel (supplement, Baselines).

    Args:
        classes: Channels of a map.
        width: Channels after the first layer; each halving of the sides doubles them.
    """

    def __init__(self, classes: int, width: int = 32):
        super().__init__()
        widths = [classes, *(width * 2**step for step in range(STEPS))]
        self.layers = nn.ModuleList(
            spectral_norm(nn.Conv2d(before, after, 4, stride=2, padding=1))
            for before, after in itertools.pairwise(widths)
        )
        self.patch = spectral_norm(nn.Conv2d(widths[-1], 1, 3, padding=1))
        self.room = nn.Sequential(
            spectral_norm(nn.Linear(2 * widths[-1], widths[-1])),
            nn.LeakyReLU(0.2),
            spectral_norm(nn.Linear(widths[-1], 1)),
        )
        self.contents = nn.Sequential(
            spectral_norm(nn.Linear(2 * classes, widths[-1])),
            nn.LeakyReLU(0.2),
            spectral_norm(nn.Linear(widths[-1], widths[-1])),
            nn.LeakyReLU(0.2),
            spectral_norm(nn.Linear(widths[-1], 1)),
        )

    def forward(
        self,
        maps: Float[Tensor, "rooms views classes height width"],
        contents: Float[Tensor, "rooms both"],
    ) -> tuple[
        Float[Tensor, "rooms views rows columns"], Float[Tensor, " rooms"], Float[Tensor, " rooms"]
    ]:
        """Scores of patches, of rooms, and of what is in them; a higher score looks more real.

        A room is what its views show on average and at most, whatever their order and number.
        What is in it (`losses.adversarial.contents`): objects of each class, and their pixels.
        """
        x = maps.flatten(0, 1)
        for layer in self.layers:
            x = F.leaky_relu(layer(x), 0.2)
        patches = self.patch(x)[:, 0].unflatten(0, maps.shape[:2])
        features = x.mean(dim=(2, 3)).unflatten(0, maps.shape[:2])
        room = torch.cat([features.mean(dim=1), features.amax(dim=1)], dim=-1)
        return GAIN * patches, GAIN * self.room(room)[:, 0], GAIN * self.contents(contents)[:, 0]
