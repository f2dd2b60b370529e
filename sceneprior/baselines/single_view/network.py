"""The network that the baselines share: what it sees of masks, and what it says of objects."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.single_view.detections import CHANNELS, CROP, NUMBERS, Detections
from sceneprior.geometry.meshes import place
from sceneprior.models.layers import mlp
from sceneprior.scene import Mesh
from sceneprior.training.method import FoundObject


class Placed(NamedTuple):
    """What is said of masks: boxes in the room."""

    centers_m: Float[Tensor, "masks 3"]
    sizes_m: Float[Tensor, "masks 3"]


class DetectionEncoder(nn.Module):
    """Features of masks, each by itself: a small convolutional network on its crop, joined with its
    box, rays and class. Published networks read colours by a ResNet instead."""

    def __init__(self, classes: int, width: int):
        super().__init__()
        self.classes = classes
        sides = (CHANNELS, width // 4, width // 2, width)
        convolutions = [
            part
            for i in range(3)
            for part in (nn.Conv2d(sides[i], sides[i + 1], 3, stride=2, padding=1), nn.ReLU())
        ]
        self.crop = nn.Sequential(
            *convolutions, nn.Flatten(), nn.Linear(width * (CROP // 8) ** 2, width)
        )
        self.numbers = nn.Linear(NUMBERS + classes, width)
        self.join = mlp(nn.Linear(2 * width, width), nn.Linear(width, width))

    def forward(self, found: Detections) -> Float[Tensor, "masks width"]:
        """One feature a mask."""
        known = F.one_hot(found.object_class, self.classes).to(found.numbers)
        numbers = self.numbers(torch.cat([found.numbers, known], dim=-1))
        return F.relu(self.join(torch.cat([self.crop(found.crops), numbers], dim=-1).relu()))


def sizes_in_room(found: Detections, sizes_m: Float[Tensor, "masks 3"]) -> Float[Tensor, "masks 3"]:
    """Extents along the axes of the images' frames, along the room's."""
    return found.to_room(sizes_m).abs()


def placed_meshes(
    found: Detections, placed: Placed, canonical: Float[Tensor, "masks vertices 3"]
) -> Float[Tensor, "masks vertices 3"]:
    """Meshes of the images' frames, whose boxes span [-1, 1]^3, in the room."""
    turned = found.to_room(canonical).unsqueeze(0)
    return place(turned, placed.centers_m[None], placed.sizes_m[None])[0]


def by_image(
    found: Detections, placed: Placed, meshes: Sequence[Mesh], images: int
) -> list[list[FoundObject]]:
    """What was found, of one view a room, in the order of its masks."""
    answers: list[list[FoundObject]] = [[] for _ in range(images)]
    numbers = (part.tolist() for part in (found.room, placed.centers_m, placed.sizes_m))
    for room, (x, y, z), (width, height, depth), mesh in zip(*numbers, meshes, strict=True):
        answers[room].append(FoundObject((x, y, z), (width, height, depth), mesh))
    return answers


def last_layer(width: int, outputs: int) -> nn.Linear:
    """A layer that says nearly nothing at first: what stands for 0 is where training begins."""
    layer = nn.Linear(width, outputs)
    with torch.no_grad():
        layer.weight *= 0.1
        layer.bias.zero_()
    return layer


def as_numpy(values: Tensor) -> np.ndarray:
    """Plain numbers of a tensor, in float64."""
    return values.detach().cpu().double().numpy()
