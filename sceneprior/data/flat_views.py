"""Rooms in, one tensor a quantity over the views of all of them out; a batch is a few gathers."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int16
from torch import Tensor

from sceneprior.geometry.turns import turn_vectors
from sceneprior.shards import RoomViews


@dataclass(frozen=True)
class FlatViews:
    """What cameras saw of a whole split, without the images: 100 bytes a view, 21 a sighting.

    A sighting is a tracked object in a view of its room, visible or not. Rooms follow each other;
    within a room, views do; within a view, objects. The last object and the last sighting are
    nothing at all: padding points at them.
    """

    object_count: Int[Tensor, " rooms"]
    first_object: Int[Tensor, " rooms"]
    first_view: Int[Tensor, " rooms"]
    first_sighting: Int[Tensor, " rooms"]
    object_class: Int16[Tensor, " objects"]
    world_to_camera: Float[Tensor, "views 4 4"]
    intrinsics: Float[Tensor, "views 3 3"]
    boxes: Float[Tensor, "sightings 4"]
    visible: Bool[Tensor, " sightings"]
    sides_clear: Bool[Tensor, "sightings 4"]

    @classmethod
    def of(cls, rooms: Sequence[RoomViews]) -> "FlatViews":
        """Lay the rooms' arrays end to end."""
        views, objects = np.array([room.visible.shape for room in rooms]).T

        def joined(name: str, *shape: int) -> Tensor:
            parts = [getattr(room, name).reshape(-1, *shape) for room in rooms]
            if name in ("object_class", "boxes", "visible", "sides_clear"):
                parts.append(np.zeros((1, *shape), parts[0].dtype))
            return torch.from_numpy(np.concatenate(parts))

        return cls(
            object_count=torch.from_numpy(objects),
            first_object=_starts(objects),
            first_view=_starts(views),
            first_sighting=_starts(views * objects),
            object_class=joined("object_class"),
            world_to_camera=joined("world_to_camera", 4, 4),
            intrinsics=joined("intrinsics", 3, 3),
            boxes=joined("boxes", 4),
            visible=joined("visible"),
            sides_clear=joined("sides_clear", 4),
        )

    @property
    def bytes(self) -> int:
        """Memory of all tensors together."""
        return sum(getattr(self, item.name).nbytes for item in fields(self))

    @property
    def device(self) -> torch.device:
        """Where the tensors are; so will be what `gather` returns."""
        return self.boxes.device

    def to(self, device: torch.device | str) -> "FlatViews":
        """The same on `device`."""
        return FlatViews(
            **{item.name: getattr(self, item.name).to(device) for item in fields(self)}
        )

    def gather(
        self,
        room: Int[Tensor, " batch"],
        view: Int[Tensor, "batch views"],
        quarter: Int[Tensor, " batch"],
        objects: int,
        blank: Bool[Tensor, " batch"] | None = None,
    ) -> dict[str, Any]:
        """Some views of some rooms, as `SceneViews` has them.

        Args:
            room: Which rooms.
            view: Which views of each, counted within the room.
            quarter: By how many quarters of a turn about +y each room is turned.
            objects: To how many the rooms are padded: the count of the largest.
            blank: Rooms to be shown without their objects; None for none.

        Returns:
            Fields of `SceneViews`, on `device`.
        """
        slot = torch.arange(objects, device=self.device)
        count = self.object_count[room][:, None]
        is_object = slot < count
        if blank is not None:
            is_object = is_object & ~blank[:, None]
        at_object = self.first_object[room][:, None] + slot
        at_object = at_object.where(is_object, len(self.object_class) - 1)
        at_sighting = (self.first_sighting[room][:, None] + view * count)[:, :, None] + slot
        at_sighting = at_sighting.where(is_object[:, None], len(self.visible) - 1)
        at_view = self.first_view[room][:, None] + view
        poses = self.world_to_camera[at_view]
        return {
            "object_class": self.object_class[at_object].long(),
            "is_object": is_object,
            # A camera sees the turned room as it saw the plain one.
            "world_to_camera": torch.cat(
                [turn_vectors(poses[..., :3], quarter), poses[..., 3:]], dim=-1
            ),
            "intrinsics": self.intrinsics[at_view],
            "boxes": self.boxes[at_sighting],
            "visible": self.visible[at_sighting],
            "sides_clear": self.sides_clear[at_sighting],
        }


def _starts(counts: np.ndarray) -> Tensor:
    return torch.from_numpy(np.cumsum(counts) - counts)
