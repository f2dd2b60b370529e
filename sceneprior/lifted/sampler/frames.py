"""Rectangles, gaps and turns of rooms as boxes: the frames in which the sampler sees rooms and
objects.

The frame of an object is its room, turned so that the object's back (`orientation.py`) is at low z.
In its own frame, a bed stands at the same place whichever of the four walls it stands against, so
all four cases are learnt as one.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.boxes import QUARTERS, turn_boxes
from sceneprior.lifted.prototypes import POSES, PosedRooms, turn_posed

BESIDE_M = 0.4
"""Largest gap between a piece and the larger one that it belongs to."""
GRAZE_M = 0.05
"""Overlap along an axis up to which an intersection of lifted boxes is attributed to their
inaccuracy."""
FRAME_M = 0.15
"""Standard deviation of the noise by which rectangles are larger than their furniture."""
OUTWARD = np.array([(0.0, -1.0), (-1.0, 0.0), (0.0, 1.0), (1.0, 0.0)])
"""Outward directions (x, z) of the sides low z, low x, high z and high x."""
SYMMETRIES = 2 * QUARTERS
"""Symmetries of a room: mirrored or not, times the quarter turns; 0 is the untransformed room."""


def shared_extents(
    boxes_m: Float[Tensor, "*#batch 6"], others_m: Float[Tensor, "*#batch 6"]
) -> Float[Tensor, "*#batch 3"]:
    """Overlap of two boxes (centre, full extents) along each axis; 0 where they are disjoint."""
    apart = (boxes_m[..., :3] - others_m[..., :3]).abs()
    total = (boxes_m[..., 3:] + others_m[..., 3:]) / 2
    least = torch.minimum(boxes_m[..., 3:], others_m[..., 3:])
    return torch.minimum(total - apart, least).clamp(min=0)


def rectangles_of(rooms: PosedRooms) -> Float[Tensor, "rooms 4"]:
    """The bounding rectangle of each room's footprints: centre x, z, extents x, z; zeros for an
    empty room."""
    if not rooms.boxes_m.shape[1]:
        return rooms.boxes_m.new_zeros(len(rooms.boxes_m), 4)
    centers, sizes = (part[..., ::2] for part in rooms.boxes_m.split(3, dim=-1))
    nowhere = ~rooms.is_object.unsqueeze(-1)
    low = (centers - sizes / 2).masked_fill(nowhere, torch.inf).amin(dim=1)
    high = (centers + sizes / 2).masked_fill(nowhere, -torch.inf).amax(dim=1)
    found = torch.cat([(low + high) / 2, high - low], dim=-1)
    return found.where(rooms.is_object.any(dim=1, keepdim=True), 0.0)


def rectangle_sides(
    rectangle_m: Float[Tensor, "*batch 4"],
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch 2"]]:
    """Lower and upper sides of rectangles (centre x, z, extents x, z)."""
    middle, extents = rectangle_m.split(2, dim=-1)
    return middle - extents / 2, middle + extents / 2


def gaps_m(rooms: PosedRooms, rectangle_m: Float[Tensor, "rooms 4"]) -> Float[Tensor, "rooms 4"]:
    """Gaps in metres between the furniture and the sides of a rectangle: the lower sides along x
    and z, then the upper ones. Meaningless in rooms without furniture."""
    low, high = rectangle_sides(rectangle_m)
    own_low, own_high = rectangle_sides(rectangles_of(rooms))
    return torch.cat([own_low - low, high - own_high], dim=-1)


def gaps_to_sides_m(
    boxes_m: Float[Tensor, "rooms objects 6"], rectangle_m: Float[Tensor, "rooms 4"]
) -> tuple[Float[Tensor, "rooms objects 2"], Float[Tensor, "rooms objects 2"]]:
    """Gaps in metres, along x and z, between each box and the sides of a rectangle at low x and low
    z, and between the box and the sides at high x and high z."""
    low, high = rectangle_sides(rectangle_m.unsqueeze(1))
    centre, half = boxes_m[..., [0, 2]], boxes_m[..., [3, 5]] / 2
    return centre - half - low, high - centre - half


def own_sides(looks: Int[Tensor, "*batch"]) -> Int[Tensor, "*batch 4"]:
    """Side of the room towards which each of the four sides of a look's prototype points; sides are
    0 to 3 for low z, low x, high z, high x."""
    pose, own = (looks % POSES).unsqueeze(-1), torch.arange(QUARTERS, device=looks.device)
    # Mirroring (x reversed) comes before the turn, and reverses the direction of sides.
    return (pose % QUARTERS + torch.where(pose >= QUARTERS, -own, own)) % QUARTERS


def side_of(
    looks: Int[Tensor, "*batch"], sides: Int[Tensor, " prototypes"]
) -> Int[Tensor, "*batch"]:
    """Side of the room towards which one side of each look's prototype points, such as its back.

    Args:
        sides: This side of each prototype in pose 0.
    """
    return own_sides(looks).gather(-1, sides[looks // POSES].unsqueeze(-1))[..., 0]


def turned_rooms(rooms: PosedRooms, symmetry: Int[Tensor, " rooms"]) -> PosedRooms:
    """Every room in one of its `SYMMETRIES`: mirrored if `symmetry` is 4 or more, then turned by
    `symmetry` % 4 quarter turns."""
    assert rooms.looks is not None
    quarters, mirrored = symmetry % QUARTERS, symmetry >= QUARTERS
    return replace(
        rooms,
        boxes_m=turn_boxes(rooms.boxes_m, quarters, mirrored),
        looks=turn_posed(rooms.looks, quarters, mirrored),
        walls_m=None
        if rooms.walls_m is None
        else torch.zeros_like(rooms.walls_m).scatter(-1, own_sides(symmetry), rooms.walls_m),
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


def mirror_images(
    rooms: PosedRooms, label: Int[Tensor, " rooms"], backs: Int[Tensor, "rooms objects"]
) -> tuple[Float[Tensor, "rooms objects 2"], Bool[Tensor, "rooms objects"]]:
    """Mirror images of objects of class `label`, at which a twin whose back is at low z would
    stand: their centres (x, z). The mirror is the middle of the nearest larger piece of another
    class, such as the bed of a nightstand or the table of a chair.

    The image along x of an object has its back at the same side, such as the other nightstand or
    the next chair on this side of the table; the image along z of an object with its back at high z
    has its back at low z, such as the chair on the other side of the table.

    Args:
        backs: Side of the room towards which the back of each object points.

    Returns:
        The places, and whether each object has one: the class must be `label`, a larger piece must
        stand within `BESIDE_M`, the back must be at low or high z, and no object of the class may
        stand at the image yet.
    """
    count = rooms.is_object.shape[1]
    centre, extents = rooms.boxes_m.split(3, dim=-1)
    away = centre.unsqueeze(1) - centre.unsqueeze(2)  # from each object to each other one
    gaps = away.abs() - (extents.unsqueeze(1) + extents.unsqueeze(2)) / 2
    centre, extents, away, level = centre[..., ::2], extents[..., ::2], away[..., ::2], gaps[..., 1]
    area, labels = extents.prod(dim=-1), rooms.object_class
    larger = (area.unsqueeze(1) > area.unsqueeze(2)) & (level < 0) & rooms.is_object.unsqueeze(1)
    others = larger & (labels.unsqueeze(1) != labels.unsqueeze(2))
    gap = gaps[..., ::2].amax(dim=-1).masked_fill(~others, torch.inf)
    if not count:
        return centre, rooms.is_object
    least, beside = gap.min(dim=-1)
    rows = torch.arange(len(away), device=away.device)[:, None], torch.arange(count), beside
    moves = torch.stack([backs == 0, backs == 2], dim=-1)  # at low z, at high z
    images = centre + 2 * away[rows] * moves
    same = rooms.is_object & (labels == label.unsqueeze(1))
    there = (images.unsqueeze(2) - centre.unsqueeze(1)).abs() < extents.unsqueeze(1) / 2
    taken = (there.all(dim=-1) & same.unsqueeze(1)).any(dim=-1)
    return images, same & moves.any(dim=-1) & (least < BESIDE_M) & ~taken
