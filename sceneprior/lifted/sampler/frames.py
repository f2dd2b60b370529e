"""The frame of an object: its room, rotated so that the object's back is at low z.

The back of a prototype is its side that is nearest to a side of the room's rectangle on average. In
its own frame, a bed stands at the same place whichever of the four walls it stands against, so all
four cases are learnt as one.
"""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.core.boxes import QUARTERS, turn_boxes
from sceneprior.lifted.prototypes import POSES, turn_posed
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.rooms import own_sides


def side_of(
    looks: Int[Tensor, "*batch"], sides: Int[Tensor, " prototypes"]
) -> Int[Tensor, "*batch"]:
    """Side of the room towards which one side of each look's prototype points, such as its back.

    Args:
        sides: This side of each prototype in pose 0.
    """
    return own_sides(looks).gather(-1, sides[looks // POSES].unsqueeze(-1))[..., 0]


def into_frames(rooms: PosedRooms, back: Int[Tensor, " rooms"]) -> PosedRooms:
    """Turn every room so that its side `back` is at low z."""
    assert rooms.looks is not None
    quarters = -back % QUARTERS
    return replace(
        rooms,
        boxes_m=turn_boxes(rooms.boxes_m, quarters),
        looks=turn_posed(rooms.looks, quarters, torch.zeros_like(quarters, dtype=torch.bool)),
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
