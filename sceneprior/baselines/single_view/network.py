"""Config and network parts that the three baselines of single-view reconstruction share."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.one_stage import OneStageConfig, OneStageTraining
from sceneprior.baselines.single_view.detections import (
    CHANNELS,
    CROP,
    NUMBERS,
    Detections,
    detections_of,
)
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.scene import Mesh
from sceneprior.core.settings import Section
from sceneprior.core.views import SceneViews
from sceneprior.paper.decoders import mlp
from sceneprior.training.method import FoundObject, TrainedReconstructor, ViewDataConfig, ready_copy


class SingleViewModel(Section):
    """Size of a network."""

    width: int = Field(128, ge=8)
    """Width of a mask's features."""


class SingleViewTraining(OneStageTraining):
    """Training settings. `data.views_per_room` sets the number of views per step, and
    `data.mask_step` the resolution of their masks."""

    learning_rate: float = Field(1e-3, gt=0)
    schedule: Literal["constant", "cosine"] = "cosine"
    """See `OneStageTraining`."""


class SingleViewConfig(OneStageConfig):
    """Config of a run of a network that reconstructs the objects of single views."""

    data: ViewDataConfig
    model: SingleViewModel
    training: SingleViewTraining

    dataset: ClassVar[type[ViewDataset]] = ViewDataset
    """Class of the training data set."""

    @model_validator(mode="after")
    def _nothing_is_without_effect(self) -> "SingleViewConfig":
        if self.data.augment_rotations:
            raise ValueError(
                f"data.augment_rotations is true, but method: {self.method} sees each room turned "
                "until the camera looks along +z, so turned copies would all be the same; "
                "set it to false"
            )
        return self

    def open_rooms(self) -> Any:
        data = self.data
        rooms = self.dataset(
            Path(data.shards), "train", views_per_room=data.views_per_room,
            view_fraction=data.view_fraction, mask_step=data.mask_step, seed=self.seed,
        )  # fmt: skip
        self.check_rooms(rooms, None)
        return rooms

    def trained(
        self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]
    ) -> TrainedReconstructor:
        return TrainedReconstructor(ready_copy(networks.prior), room_ids, self, stage)


class Placed(NamedTuple):
    """One predicted or true box per mask, in the room frame."""

    centers_m: Float[Tensor, "masks 3"]
    sizes_m: Float[Tensor, "masks 3"]

    @classmethod
    def of(
        cls,
        found: Detections,
        offsets: Float[Tensor, "masks 2"],
        distances_m: Float[Tensor, " masks"],
        sizes_m: Float[Tensor, "masks 3"],
    ) -> "Placed":
        """Boxes from a network's outputs: `Detections.centers_at` explains offsets and distances;
        sizes are along the axes of the image's frame."""
        return cls(found.centers_at(offsets, distances_m), found.to_room(sizes_m).abs())

    def points_m(
        self, found: Detections, points: Float[Tensor, "masks points 3"]
    ) -> Float[Tensor, "masks points 3"]:
        """Points in metres in the room, from points in the image's frame where each box is
        [-1, 1]^3."""
        return found.to_room(points) * (self.sizes_m / 2).unsqueeze(1) + self.centers_m.unsqueeze(1)


class ViewNetwork(nn.Module, ABC):
    """A network that reconstructs the objects behind the masks of single views."""

    @abstractmethod
    def reconstruct(self, found: Detections) -> tuple[Placed, Iterable[Mesh]]:
        """One box and one mesh per mask, in the room frame."""

    @torch.no_grad()
    def find(self, views: SceneViews) -> list[list[FoundObject]]:
        found = detections_of(views)
        placed, meshes = self.reconstruct(found)
        answers: list[list[FoundObject]] = [[] for _ in views.room_index]
        numbers = (part.tolist() for part in (found.room, placed.centers_m, placed.sizes_m))
        for room, (x, y, z), (width, height, depth), mesh in zip(*numbers, meshes, strict=True):
            answers[room].append(FoundObject((x, y, z), (width, height, depth), mesh))
        return answers


class DetectionEncoder(nn.Module):
    """Encodes each mask independently: a small convolutional network reads the mask's crop, and a
    linear layer reads its 2D box, rays and class. The published networks read colours with a ResNet
    instead."""

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
        """One feature vector per mask."""
        numbers, known = found.numbers, F.one_hot(found.object_class, self.classes)
        numbers = self.numbers(torch.cat([numbers, known.to(numbers)], dim=-1))
        return F.relu(self.join(torch.cat([self.crop(found.crops), numbers], dim=-1).relu()))


def meshes_of(
    vertices_m: Float[Tensor, "masks vertices 3"], faces: Int[Tensor, "faces 3"]
) -> list[Mesh]:
    """One mesh per mask; all have the same faces."""
    triangles = faces.cpu().numpy()
    return [Mesh(as_numpy(vertices), triangles) for vertices in vertices_m]


def last_layer(width: int, outputs: int) -> nn.Linear:
    """A linear layer whose outputs start close to 0: small weights, zero bias."""
    layer = nn.Linear(width, outputs)
    with torch.no_grad():
        layer.weight *= 0.1
        layer.bias.zero_()
    return layer


def as_numpy(values: Tensor) -> np.ndarray:
    """A tensor as a float64 array."""
    return values.detach().cpu().double().numpy()
