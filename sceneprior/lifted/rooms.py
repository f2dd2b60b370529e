"""Rooms whose objects are posed prototypes."""

from dataclasses import dataclass, fields, replace
from typing import Any

from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.views import DecodedScenes, RoomBoxes


@dataclass(frozen=True)
class PosedScenes(DecodedScenes):
    """Decoded scenes whose shapes are prototypes in poses."""

    shape_codes: Float[Tensor, "rooms objects codes"] | None = None
    """Predicted shape codes (`lifted/prototype_decoder.py`); None if shapes are deformed meshes."""
    looks: Int[Tensor, "rooms objects"] | None = None
    """Look of each object, that is, its prototype and pose as one index: prototype * 8 + pose
    (`lifted/prototypes.py`). None before the shape decoder has run, and if it predicts meshes."""
    next_looks: Int[Tensor, "rooms objects"] | None = None
    """Look into which each object changes along a path; None if the room is not on a path."""
    shares: Float[Tensor, "rooms objects"] | None = None
    """Share of `next_looks` in each object's shape, at least 0 and less than 1."""

    @classmethod
    def of(cls, scenes: DecodedScenes, **shapes: Any) -> "PosedScenes":
        """Decoded scenes with these shapes."""
        return cls(**{each.name: getattr(scenes, each.name) for each in fields(scenes)} | shapes)


@dataclass(frozen=True)
class PosedRooms(RoomBoxes):
    """Rooms as boxes with posed prototypes, in the rectangles in which they were furnished."""

    looks: Int[Tensor, "rooms objects"] | None = None
    """Look of each object, prototype * 8 + pose (`lifted/prototypes.py`); None if unknown."""
    rectangle_m: Float[Tensor, "rooms 4"] | None = None
    """Rectangle in which each room was furnished: centre x, z and extents x, z; None if unknown."""
    walls_m: Float[Tensor, "rooms 4"] | None = None
    """Distances of the walls near the furniture from the origin, outwards, at low z, low x, high z
    and high x; NaN where no wall is known. None if no walls are known."""

    def take(self, order: Int[Tensor, "rooms slots"]) -> "PosedRooms":
        """Gather the slots of each room in the order of the indices `order`."""
        # Rectangles and walls have no slots.
        slots = super(PosedRooms, replace(self, rectangle_m=None, walls_m=None)).take(order)
        return replace(slots, rectangle_m=self.rectangle_m, walls_m=self.walls_m)
