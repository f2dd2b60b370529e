"""Batches of rooms: `SceneViews`, `LiftedRooms`, `DecodedScenes`, `RoomBoxes`."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int, Integer
from torch import Tensor

_B = TypeVar("_B", bound="_Batch")


@dataclass(frozen=True)
class _Batch:
    def changed(self: _B, change: Callable[[Tensor], Tensor]) -> _B:
        """The same with every tensor changed."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return replace(
            self, **{key: change(v) for key, v in values.items() if isinstance(v, Tensor)}
        )

    def to(self: _B, device: torch.device | str) -> _B:
        """The same with every tensor on `device` (Lightning calls this)."""
        return self.changed(lambda tensor: tensor.to(device))


@dataclass(frozen=True)
class SceneViews(_Batch):
    """What cameras saw of a batch of rooms; objects are padded to the largest room's count.

    Cameras are OpenCV pinholes (x right, y down, z forward); see docs/conventions.md.
    """

    room_index: Int[Tensor, " rooms"]
    """Row of each room in the data set: which latent vector is its own."""
    object_class: Int[Tensor, "rooms objects"]
    """Index into the label set; 0 where `is_object` is false."""
    is_object: Bool[Tensor, "rooms objects"]
    """False for padding. The first n entries of a room with n tracked objects are true."""
    world_to_camera: Float[Tensor, "rooms views 4 4"]
    intrinsics: Float[Tensor, "rooms views 3 3"]
    """Pixels of an image of `image_size`."""
    boxes: Float[Tensor, "rooms views objects 4"]
    """x1, y1, x2, y2 of the visible mask, relative to the image size, in [0, 1]."""
    visible: Bool[Tensor, "rooms views objects"]
    sides_clear: Bool[Tensor, "rooms views objects 4"]
    """Which sides of a box are the object's own; another object touches the mask at the rest."""
    image_size: tuple[int, int]
    """Height and width in pixels that `intrinsics` refer to."""
    instance_ids: Integer[Tensor, "rooms views height width"] | None = None
    """0 for nothing, k + 1 for object k; its own, smaller size. Only the shape stage has it."""
    room_ids: tuple[str, ...] = ()

    @property
    def observed_ids(self) -> Integer[Tensor, "rooms views height width"]:
        """The instance-id images, where they cannot be done without.

        Raises:
            ValueError: the views were loaded without them.
        """
        if self.instance_ids is None:
            raise ValueError("These views have no instance ids; load the data with a mask_step.")
        return self.instance_ids

    def intrinsics_at(
        self, height: int | float, width: int | float
    ) -> Float[Tensor, "rooms views 3 3"]:
        """The cameras' intrinsics in pixels of images of another size."""
        full_height, full_width = self.image_size
        scale = self.intrinsics.new_tensor([width / full_width, height / full_height, 1])
        return self.intrinsics * scale[:, None]


@dataclass(frozen=True)
class DecodedScenes:
    """A batch of decoded latents: N objects a room, in the order of generation."""

    class_logits: Float[Tensor, "rooms objects classes"]
    centers_m: Float[Tensor, "rooms objects 3"]
    """Box centres in the room frame; y already includes half the height."""
    sizes_m: Float[Tensor, "rooms objects 3"]
    """Full extents of the axis-aligned boxes."""
    completeness_logits: Float[Tensor, "rooms objects"]
    """Before the sigmoid; `losses/completeness.py` reads them (`kept_objects`)."""
    bevels: Float[Tensor, "rooms objects 2"] | None = None
    """How far the edges of the proxy `beveled_box` are cut off (`geometry.meshes`); None
    for rooms that no prior decoded."""
    vertices_m: Float[Tensor, "rooms objects vertices 3"] | None = None
    """Mesh vertices in the room frame; None until the shape decoder ran, or where it chooses looks.
    """
    shape_codes: Float[Tensor, "rooms objects codes"] | None = None
    """What shapes are learnt as (`models.occupancy`); None where they are deformed meshes."""
    looks: Int[Tensor, "rooms objects"] | None = None
    """Which shape each object has, in which pose (`models/prototypes.py`); None until the shape
    decoder ran, or where it makes meshes."""


@dataclass(frozen=True)
class LiftedRooms(_Batch):
    """Tracked objects of a batch of rooms as `lifting` found them in 3D, from masks alone;
    objects are padded to the fullest room's count."""

    room_index: Int[Tensor, " rooms"]
    """Row of each room in the data set: which latent vector is its own."""
    object_class: Int[Tensor, "rooms objects"]
    """Index into the label set; 0 where `is_object` is false."""
    is_object: Bool[Tensor, "rooms objects"]
    """False for padding; the first n entries of a room with n tracked objects are true."""
    is_lifted: Bool[Tensor, "rooms objects"]
    """Whether the box is known: some view showed the object."""
    boxes_m: Float[Tensor, "rooms objects 6"]
    """Centre x, y, z, then full extents; axis-aligned, in the room frame."""
    looks: Int[Tensor, "rooms objects"] | None = None
    """Which prototype in which pose its lifted shape is nearest to (`models/prototypes.py`); -1
    where there is none."""
    room_ids: tuple[str, ...] = ()


@dataclass(frozen=True)
class RoomBoxes(_Batch):
    """A batch of rooms as labelled boxes in 3D: what supervision in 3D shows, and what methods that
    learn from it make. Objects are padded to the fullest room's count; their order means nothing.
    """

    object_class: Int[Tensor, "rooms objects"]
    """Index into the label set; 0 where `is_object` is false."""
    is_object: Bool[Tensor, "rooms objects"]
    """False for padding; the first n entries of a room with n objects are true."""
    boxes_m: Float[Tensor, "rooms objects 6"]
    """Centre x, y, z, then full extents along x, y, z; axis-aligned, in the room frame."""
    room_ids: tuple[str, ...] = ()
    yaw_rad: Float[Tensor, "rooms objects"] | None = None
    """Turn about +y that takes +z to each piece's front, in [-pi, pi]; None: nobody knows."""
    looks: Int[Tensor, "rooms objects"] | None = None
    """Which prototype each object looks like, times 8, plus the pose in which it does
    (`models/prototypes.py`); None: nobody knows."""

    def split(self, rooms: int) -> list["RoomBoxes"]:
        """Batches of at most so many rooms, without ids."""

        def batch(start: int) -> "RoomBoxes":
            part = self.changed(lambda tensor: tensor[start : start + rooms])
            return replace(part, room_ids=())

        return [batch(start) for start in range(0, len(self.is_object), rooms)]

    def only(self, here: Bool[Tensor, "rooms objects"]) -> "RoomBoxes":
        """The same slots, but empty where `here` is false."""
        return replace(self, object_class=self.object_class * here, is_object=self.is_object & here)

    def take(self, order: Int[Tensor, "rooms slots"]) -> "RoomBoxes":
        """The same rooms with other slots: those that `order` names, in its order."""

        def taken(tensor: Tensor) -> Tensor:
            rows = order if tensor.ndim == 2 else order.unsqueeze(-1)
            return torch.take_along_dim(tensor, rows, dim=1)

        return self.changed(taken)
