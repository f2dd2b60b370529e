"""The frame of an object: its room, turned so that the object's back is at low z.

The back of a prototype is its side that is nearest to a side of the room's rectangle on average. In
its own frame, a bed stands at the same place whichever of the four walls it stands against, so all
four cases are learnt as one.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.geometry.turns import QUARTERS, turn_boxes
from sceneprior.core.views import RoomBoxes
from sceneprior.lifted.prototypes import POSES, turned_looks
from sceneprior.lifted.sampler.rooms import gaps_to_sides_m, rectangles_of

FURTHEST_M = 1.0
"""Length to which gaps to the sides of the rectangle are clipped before they are averaged."""


def backs_of(
    looks: Int[Tensor, "*batch"], backs: Int[Tensor, " prototypes"]
) -> Int[Tensor, "*batch"]:
    """The side at which each look has its back: 0 to 3 for low z, low x, high z, high x.

    Args:
        backs: The side at which each prototype has its back in pose 0.
    """
    pose, own = looks % POSES, backs[looks // POSES]
    # Mirroring (x reversed) comes before the turn, and reverses the direction of sides.
    return (pose % QUARTERS + torch.where(pose >= QUARTERS, -own, own)) % QUARTERS


def into_frames(rooms: RoomBoxes, back: Int[Tensor, " rooms"]) -> RoomBoxes:
    """Turn every room so that its side `back` is at low z."""
    assert rooms.looks is not None
    quarters = -back % QUARTERS
    return replace(
        rooms,
        boxes_m=turn_boxes(rooms.boxes_m, quarters),
        looks=turned_looks(rooms.looks, quarters, torch.zeros_like(quarters, dtype=torch.bool)),
    )


def turn_rectangles(
    rectangle_m: Float[Tensor, "rooms 4"], quarters: Int[Tensor, " rooms"]
) -> Float[Tensor, "rooms 4"]:
    """Rectangles (centre x, z, extents x, z) after their rooms are turned by `quarters`."""
    x, z, along_x, along_z = rectangle_m.unbind(dim=-1)
    nothing = torch.zeros_like(x)
    boxes_m = torch.stack([x, nothing, z, along_x, nothing, along_z], dim=-1)
    return turn_boxes(boxes_m.unsqueeze(1), quarters)[:, 0, [0, 2, 3, 5]]


def turn_places(
    place_m: Float[Tensor, "rooms 2"], quarters: Int[Tensor, " rooms"]
) -> Float[Tensor, "rooms 2"]:
    """Places (x, z) after their rooms are turned by `quarters`."""
    nothing = torch.zeros_like(place_m)
    return turn_rectangles(torch.cat([place_m, nothing], dim=-1), quarters)[:, :2]


def find_backs(rooms: RoomBoxes, prototypes: int) -> Int[Tensor, " prototypes"]:
    """The side of each prototype, in pose 0, with the smallest mean gap to the sides of its rooms'
    rectangles; 0 for unused prototypes."""
    assert rooms.looks is not None
    rectangle_m = rectangles_of(rooms)
    total = torch.zeros(prototypes, QUARTERS)
    plain = torch.zeros(prototypes, dtype=torch.int64)
    for slot in range(rooms.is_object.shape[1]):
        here, looks = rooms.is_object[:, slot], rooms.looks[:, slot]
        quarters = -backs_of(looks, plain) % QUARTERS
        box_m = turn_boxes(rooms.boxes_m[:, slot, None], quarters)
        low, high = gaps_to_sides_m(box_m, turn_rectangles(rectangle_m, quarters))
        mirrored = looks % POSES >= QUARTERS
        along_x = torch.stack([low[:, 0, 0], high[:, 0, 0]], dim=-1)
        along_x = torch.where(mirrored[:, None], along_x.flip(-1), along_x)
        gaps_m = torch.stack([low[:, 0, 1], along_x[:, 0], high[:, 0, 1], along_x[:, 1]], dim=-1)
        total.index_add_(0, looks[here] // POSES, gaps_m[here].clamp(max=FURTHEST_M))
    return total.argmin(dim=1)
