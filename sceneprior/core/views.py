"""Batches of rooms: their views, decoded scenes, and labelled boxes."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor

_B = TypeVar("_B", bound="Batch")
_Rooms = TypeVar("_Rooms", bound="RoomBoxes")


@dataclass(frozen=True)
class Batch:
    """Tensors that are moved and sliced together."""

    def changed(self: _B, change: Callable[[Tensor], Tensor]) -> _B:
        """Copy of the batch with `change` applied to every tensor."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(
            self, **{key: change(v) for key, v in values.items() if isinstance(v, Tensor)}
        )

    def to(self: _B, device: torch.device | str) -> _B:
        """Copy of the batch on `device` (called by Lightning)."""
        return self.changed(lambda tensor: tensor.to(device))


@dataclass(frozen=True)
class SceneViews(Batch):
    """Views of a batch of rooms; objects are padded to the largest room's count.

    Cameras are OpenCV pinholes (x right, y down, z forward); see docs/conventions.md.
    """

    room_index: Int[Tensor, " rooms"]
    """Row of each room in the data set, which is also the row of its latent vector."""
    object_class: Int[Tensor, "rooms objects"]
    """Index into the label set; 0 where `is_object` is false."""
    is_object: Bool[Tensor, "rooms objects"]
    """False for padding. The first n entries of a room with n tracked objects are true."""
    world_to_camera: Float[Tensor, "rooms views 4 4"]
    intrinsics: Float[Tensor, "rooms views 3 3"]
    """Intrinsics in pixels of an image of `image_size`."""
    boxes: Float[Tensor, "rooms views objects 4"]
    """2D boxes x1, y1, x2, y2 of the visible masks, relative to the image size, in [0, 1]."""
    visible: Bool[Tensor, "rooms views objects"]
    sides_clear: Bool[Tensor, "rooms views objects 4"]
    """Sides of the 2D boxes at which no other object touches the mask (x1, y1, x2, y2)."""
    image_size: tuple[int, int]
    """Height and width in pixels that `intrinsics` refer to."""
    instance_ids: Integer[Tensor, "rooms views height width"] | None = None
    """Downsampled images of ids: 0 for background, k + 1 for object k, n + 1 for void in a room of
    n objects. None except in the shape stage."""
    room_ids: tuple[str, ...] = ()

    @property
    def observed_ids(self) -> Integer[Tensor, "rooms views height width"]:
        """Instance-id images, for callers that need them."""
        if self.instance_ids is None:
            raise ValueError("These views have no instance ids; load the data with a mask_step.")
        return self.instance_ids

    @property
    def known_pixels(self) -> Bool[Tensor, "rooms views height width"]:
        """Pixels of the instance-id images that are not void."""
        objects = self.is_object.sum(dim=-1)
        return self.observed_ids <= objects[:, None, None, None]

    def intrinsics_at(
        self, height: int | float, width: int | float
    ) -> Float[Tensor, "rooms views 3 3"]:
        """Intrinsics in pixels of images of another size."""
        full_height, full_width = self.image_size
        scale = self.intrinsics.new_tensor([width / full_width, height / full_height, 1])
        return self.intrinsics * scale[:, None]


@dataclass(frozen=True)
class DecodedScenes:
    """A batch of decoded latents: N objects per room, in the order of generation."""

    class_logits: Float[Tensor, "rooms objects classes"]
    centers_m: Float[Tensor, "rooms objects 3"]
    """Box centres in the room frame; y already includes half the height."""
    sizes_m: Float[Tensor, "rooms objects 3"]
    """Full extents of the axis-aligned boxes."""
    completeness_logits: Float[Tensor, "rooms objects"]
    """Completeness before the sigmoid; see `kept_objects` in `paper/losses.py`."""
    bevels: Float[Tensor, "rooms objects 2"] | None = None
    """Bevels of the proxy `beveled_box` (`beveled_cube` in `core/proxies.py`); None for
    rooms that were not decoded by a prior."""
    vertices_m: Float[Tensor, "rooms objects vertices 3"] | None = None
    """Mesh vertices in the room frame; None before the shape decoder has run, and for
    methods without meshes."""


@dataclass(frozen=True)
class RoomBoxes(Batch):
    """A batch of rooms as labelled 3D boxes: the supervision and the output of methods that learn
    from boxes.

    Each room is padded to the batch's highest number of objects. The order of objects has no
    meaning.
    """

    object_class: Int[Tensor, "rooms objects"]
    """Index into the label set; 0 where `is_object` is false."""
    is_object: Bool[Tensor, "rooms objects"]
    """False for padding; the first n entries of a room with n objects are true."""
    boxes_m: Float[Tensor, "rooms objects 6"]
    """Axis-aligned boxes in the room frame: centre x, y, z, then full extents along x, y, z."""
    room_ids: tuple[str, ...] = ()
    yaw_rad: Float[Tensor, "rooms objects"] | None = None
    """Rotation about +y that takes +z to each piece's front, in [-pi, pi]; None if unknown."""

    def split(self: _Rooms, rooms: int) -> list[_Rooms]:
        """Split into batches of at most `rooms` rooms, without ids."""

        def batch(start: int) -> _Rooms:
            part = self.changed(lambda tensor: tensor[start : start + rooms])
            return replace(part, room_ids=())

        return [batch(start) for start in range(0, len(self.is_object), rooms)]

    def only(self: _Rooms, here: Bool[Tensor, "rooms objects"]) -> _Rooms:
        """Copy that keeps the objects where `here` is true; the other slots become padding."""
        return replace(self, object_class=self.object_class * here, is_object=self.is_object & here)

    def take(self: _Rooms, order: Int[Tensor, "rooms slots"]) -> _Rooms:
        """Gather the slots of each room in the order of the indices `order`."""

        def taken(tensor: Tensor) -> Tensor:
            rows = order if tensor.ndim == 2 else order.unsqueeze(-1)
            return torch.take_along_dim(tensor, rows, dim=1)

        return self.changed(taken)
