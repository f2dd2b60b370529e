"""Masks of single images as network inputs, and what the three baselines share: their config, the
encoder of a mask, and boxes and meshes as output.

Inputs and outputs are in the image's frame: the room's, moved to the camera and turned by quarters
until the camera looks along +z to within 45 degrees. So they do not change if the room is moved or
turned by quarters, and boxes stay axis-aligned.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.baselines.one_stage import OneStageConfig, OneStageTraining
from sceneprior.core.boxes import QUARTERS, turn_vectors
from sceneprior.core.cameras import camera_centers
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.scene import Mesh
from sceneprior.core.settings import Section
from sceneprior.core.views import SceneViews
from sceneprior.paper.decoders import mlp
from sceneprior.training.method import FoundObject, TrainedReconstructor, ViewDataConfig, ready_copy

CROP = 32
"""Pixels along each side of a crop."""
MARGIN = 0.25
"""Border of a crop on each side of its 2D box, as a share of the box's width or height."""
CHANNELS = 6
"""Channels of a crop: the mask, all other masks (including void), whether the pixel is inside the
image, and the pixel's ray (3)."""
NUMBERS = 26
"""Number of inputs per mask in addition to its crop and class; see `Detections.numbers`."""
NEAR_M = 0.1
"""Minimum depth of a centre that is projected into the image."""


@dataclass(frozen=True)
class Detections:
    """The visible masks of a batch of images, one per row, image after image.

    Every view of every room is an image.
    """

    views: SceneViews
    image: Int[Tensor, " masks"]
    slot: Int[Tensor, " masks"]
    """Index of the mask within its image."""
    room: Int[Tensor, " masks"]
    view: Int[Tensor, " masks"]
    item: Int[Tensor, " masks"]
    """Index of the mask's object in the room."""
    object_class: Int[Tensor, " masks"]
    boxes: Float[Tensor, "masks 4"]
    """2D boxes in the format of `SceneViews`, relative to the image."""
    quarter: Int[Tensor, " masks"]
    """Number of quarter turns from the room into the image's frame."""
    eye_m: Float[Tensor, "masks 3"]
    """Camera position in the room."""
    frame_to_camera: Float[Tensor, "masks 3 3"]
    intrinsics: Float[Tensor, "masks 3 3"]
    """Intrinsics in units of the image's width and height."""

    def __len__(self) -> int:
        return len(self.image)

    @property
    def numbers(self) -> Float[Tensor, "masks numbers"]:
        """The 2D box (4), the logs of its width and height (2), its sides that no other object
        touches (4), the rays through its centre and corners (15), and the camera's height (1)."""
        x1, y1, x2, y2 = self.boxes.unbind(dim=-1)
        corners = [((x1 + x2) / 2, (y1 + y2) / 2), (x1, y1), (x2, y1), (x1, y2), (x2, y2)]
        rays = self.rays(torch.stack([torch.stack(place, dim=-1) for place in corners], dim=1))
        sides = (self.boxes[:, 2:] - self.boxes[:, :2]).clamp(min=1e-3).log()
        clear = self.views.sides_clear[self.room, self.view, self.item].to(sides)
        return torch.cat([self.boxes, sides, clear, rays.flatten(1), self.eye_m[:, 1:2]], dim=-1)

    @property
    def crops(self) -> Float[Tensor, "masks channels rows columns"]:
        """Each 2D box with its border, stretched to a square of `CROP` pixels; see `CHANNELS`."""
        ids = self.views.observed_ids[self.room, self.view]
        steps = (torch.arange(CROP, device=ids.device) + 0.5) / CROP
        steps = steps * (1 + 2 * MARGIN) - MARGIN
        low, high = self.boxes[:, None, :2], self.boxes[:, None, 2:]
        place = low + steps[:, None] * (high - low)  # masks, steps, (u, v)
        u, v = (
            part.expand(-1, CROP, CROP) for part in (place[:, None, :, 0], place[:, :, None, 1])
        )
        inside = (u >= 0) & (u < 1) & (v >= 0) & (v < 1)
        height, width = ids.shape[1:]
        column = (u * width).long().clamp(0, width - 1)
        row = (v * height).long().clamp(0, height - 1)
        seen = ids[torch.arange(len(ids), device=ids.device)[:, None, None], row, column].long()
        seen = seen * inside
        own = seen == self.item[:, None, None] + 1
        rays = self.rays(torch.stack([u, v], dim=-1).flatten(1, 2)).unflatten(1, (CROP, CROP))
        masks = torch.stack([own, (seen > 0) & ~own, inside], dim=1).to(rays)
        return torch.cat([masks, rays.movedim(-1, 1)], dim=1)

    def rays(self, places: Float[Tensor, "masks points 2"]) -> Float[Tensor, "masks points 3"]:
        """Unit vectors from the camera through places (u, v), in the image's frame."""
        focal = self.intrinsics[:, None, (0, 1), (0, 1)]
        middle = self.intrinsics[:, None, :2, 2]
        on_plane = (places - middle) / focal
        rays = torch.cat([on_plane, torch.ones_like(on_plane[..., :1])], dim=-1)
        return F.normalize(rays @ self.frame_to_camera, dim=-1)

    def centers_at(
        self, offsets: Float[Tensor, "masks 2"], distances_m: Float[Tensor, " masks"]
    ) -> Float[Tensor, "masks 3"]:
        """Centres in the room, from their distances to the camera, and the offsets from the middle
        of the 2D box to the projected centre in units of the 2D box's width and height."""
        low, high = self.boxes.split(2, dim=-1)
        place = (low + high) / 2 + offsets * (high - low)
        away = self.rays(place.unsqueeze(1))[:, 0] * distances_m.unsqueeze(-1)
        return self.to_room(away) + self.eye_m

    def offsets_and_distances(
        self, centers_m: Float[Tensor, "masks 3"]
    ) -> tuple[Float[Tensor, "masks 2"], Float[Tensor, " masks"], Bool[Tensor, " masks"]]:
        """The inverse of `centers_at`; the third result is True for centres in front of the camera.

        The offsets of centres behind the camera are 0.
        """
        away = self.to_frame(centers_m - self.eye_m)
        seen = (self.frame_to_camera @ away.unsqueeze(-1))[..., 0]
        ahead = seen[:, 2] > NEAR_M
        scaled = (self.intrinsics @ seen.unsqueeze(-1))[..., 0]
        place = scaled[:, :2] / scaled[:, 2:].clamp(min=NEAR_M)
        low, high = self.boxes.split(2, dim=-1)
        offsets = (place - (low + high) / 2) / (high - low).clamp(min=1e-3)
        return offsets * ahead.unsqueeze(-1), away.norm(dim=-1), ahead

    def to_frame(self, vectors: Float[Tensor, "masks *many 3"]) -> Float[Tensor, "masks *many 3"]:
        """Rotate directions from the room frame into the images' frames."""
        return turn_vectors(vectors, self.quarter)

    def to_room(self, vectors: Float[Tensor, "masks *many 3"]) -> Float[Tensor, "masks *many 3"]:
        """Rotate directions from the images' frames into the room frame."""
        return turn_vectors(vectors, (QUARTERS - self.quarter) % QUARTERS)

    def padded(self, values: Float[Tensor, "masks width"]) -> Float[Tensor, "images most width"]:
        """Values by image and mask, padded with zeros to the largest number of masks."""
        images = int(self.image.max()) + 1 if len(self) else 0
        most = int(self.slot.max()) + 1 if len(self) else 0
        empty = values.new_zeros(images, most, values.shape[-1])
        return empty.index_put((self.image, self.slot), values)

    def of_objects(self, values: Tensor, rooms: int, objects: int) -> Tensor:
        """Values by room and object, (rooms, objects, ...), for a single view per room; 0 for
        objects without a mask."""
        empty = values.new_zeros(rooms, objects, *values.shape[1:])
        return empty.index_put((self.room, self.item), values)


def some_views(views: SceneViews, part: slice) -> SceneViews:
    """The batch, reduced to the views `part` of each room."""
    names = ("world_to_camera", "intrinsics", "boxes", "visible", "sides_clear", "instance_ids")
    return replace(views, **{name: getattr(views, name)[:, part] for name in names})


def detections_of(views: SceneViews) -> Detections:
    """The visible masks of all views."""
    room, view, item = views.visible.nonzero(as_tuple=True)
    image = room * views.visible.shape[1] + view
    counts = image.bincount(minlength=1)
    slot = torch.arange(len(image), device=image.device) - (counts.cumsum(0) - counts)[image]
    poses = views.world_to_camera[room, view]
    forward = poses[:, 2, :3]
    yaw = torch.atan2(forward[:, 0], forward[:, 2])
    quarter = torch.remainder(-torch.round(yaw / (math.pi / 2)).long(), QUARTERS)
    height, width = views.image_size
    scale = views.intrinsics.new_tensor([[1 / width], [1 / height], [1.0]])
    return Detections(
        views=views,
        image=image,
        slot=slot,
        room=room,
        view=view,
        item=item,
        object_class=views.object_class[room, item],
        boxes=views.boxes[room, view, item],
        quarter=quarter,
        eye_m=camera_centers(poses),
        frame_to_camera=turn_vectors(poses[:, :3, :3], quarter),
        intrinsics=views.intrinsics[room, view] * scale,
    )


class SingleViewModel(Section):
    """Size of a network."""

    width: int = Field(128, ge=8)
    """Width of a mask's features."""


class SingleViewTraining(OneStageTraining):
    """Training settings. `data.views_per_room` sets the number of views per step, and
    `data.mask_step` the resolution of their masks."""

    learning_rate: float = Field(1e-3, gt=0)
    schedule: Literal["constant", "cosine"] = "cosine"


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

    def open_rooms(self, split: str = "train") -> Any:
        data = self.data
        rooms = self.dataset(
            Path(data.shards), split, views_per_room=data.views_per_room,
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
        for room, center_m, size_m, mesh in zip(*numbers, meshes, strict=True):
            answers[room].append(FoundObject(tuple(center_m), tuple(size_m), mesh))
        return answers


class DetectionEncoder(nn.Module):
    """Encodes each mask independently: a small convolutional network reads the mask's crop, and a
    linear layer reads its 2D box, rays and class. The published networks read colours with a ResNet
    instead."""

    def __init__(self, classes: int, width: int):
        super().__init__()
        self.classes = classes
        sides = (CHANNELS, width // 4, width // 2, width)
        convolutions: list[nn.Module] = []
        for inputs, outputs in pairwise(sides):
            convolutions += [nn.Conv2d(inputs, outputs, 3, stride=2, padding=1), nn.ReLU()]
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
