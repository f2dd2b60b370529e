"""Anchors: positions at which an object can stand along an axis, given by the room and by the
objects already placed; and features of its relations to these at any position."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

BY_SIDES = 8
"""Number of anchors along an axis given by the room: a narrow and a wide one at each of four
positions. These are flush with the lower side of the rectangle, flush with its upper side, in its
middle, and at the origin, which is the middle of the floor."""
BY_OBJECT = 10
"""Number of anchors along an axis per object already placed: adjacent before it, flush with its
lower side, centred, flush with its upper side, adjacent behind it, `APART_M` before and behind it,
midway between it and the lower and the upper side of the rectangle, and at its mirror image
(`mirror_images`)."""
APART_M = 0.4
"""Gap between an object and the two anchors apart from it."""
GAPS_M = (-0.4, -0.15, -0.05, 0.0, 0.05, 0.15, 0.4, 0.7, 1.0, 1.5, 2.0)
"""Knots of `ramps` for gaps; negative gaps are overlaps."""
OFFSETS_M = (-1.5, -0.7, -0.3, -0.1, -0.03, 0.03, 0.1, 0.3, 0.7, 1.5)
"""Knots of `ramps` for offsets of centres and sides."""
NEAR_M = (0.05, 0.15, 0.5)
"""Distances from a mirror image at which its features become 0."""
OF_GAP, OF_OFFSET = len(GAPS_M) - 1, len(OFFSETS_M) - 1
OF_OBJECT, OF_SIDES = OF_GAP + 3 * OF_OFFSET + len(NEAR_M), 4 * OF_GAP
"""Number of features, along an axis, of the relation to an object; and of the two sides of the
rectangle: the gap to the object, and what stays free beside all furniture."""


def ramps(lengths_m: Float[Tensor, "*batch n"], knots_m: tuple[float, ...]) -> Tensor:
    """Piecewise linear features of lengths: each rises from 0 to 1 between two knots.

    Example:

        >>> ramps(torch.tensor([0.5]), (0.0, 1.0, 2.0))
        tensor([0.5000, 0.0000])
    """
    knots = torch.tensor(knots_m).to(lengths_m)
    rising = lengths_m.unsqueeze(-1) - knots[:-1]
    return rising.div_(knots.diff()).clamp_(0, 1).flatten(-2)


class Anchors(NamedTuple):
    """Candidate positions of an object along an axis."""

    at_m: Float[Tensor, "rooms anchors"]
    exists: Bool[Tensor, "rooms anchors"]
    """False for the anchors of padding."""
    kind: Int[Tensor, " anchors"]
    """0 to 7 for anchors given by the room, 8 to 17 for anchors of an object."""


class Surroundings(NamedTuple):
    """The footprint (x, z) of an object to be placed, and what its room holds so far. Tensors refer
    to the frame of that object (`frames.py`)."""

    size_m: Float[Tensor, "rooms 2"]
    rectangle_m: Float[Tensor, "rooms 4"]
    footprints_m: Float[Tensor, "rooms objects 4"]
    """Centre x, z and extents x, z of the objects already placed."""
    is_object: Bool[Tensor, "rooms objects"]
    images_m: Float[Tensor, "rooms objects 2"]
    """Mirror image (x, z) of each placed object of the same class; see `mirror_images`."""
    has_image: Bool[Tensor, "rooms objects"]

    def rows(self, rows: Int[Tensor, " some"]) -> "Surroundings":
        """Those of these rooms."""
        return Surroundings(*(part[rows] for part in self))

    def anchors(self, axis: int) -> Anchors:
        """The anchors along x (0) or z (1)."""
        middle, extent = self.rectangle_m[:, axis], self.rectangle_m[:, 2 + axis]
        size = self.size_m[:, axis]
        free = ((extent - size) / 2).clamp(min=0)
        sides = torch.stack([middle - free, middle + free, middle, torch.zeros_like(free)], dim=1)
        sides = sides.repeat_interleave(2, dim=1)
        centre, theirs = self.footprints_m[..., axis], self.footprints_m[..., 2 + axis]
        total, difference = (theirs + size.unsqueeze(1)) / 2, (theirs - size.unsqueeze(1)) / 2
        away = torch.stack(
            [-total, -difference, torch.zeros_like(total), difference, total,
             -total - APART_M, total + APART_M], dim=-1,
        )  # fmt: skip
        low_m, high_m = (middle - extent / 2).unsqueeze(1), (middle + extent / 2).unsqueeze(1)
        before_m, behind_m = centre - theirs / 2, centre + theirs / 2
        midway = [(low_m + before_m) / 2, (behind_m + high_m) / 2]
        has_room = torch.stack([before_m - low_m, high_m - behind_m], dim=-1) >= size[:, None, None]
        beside = torch.cat([
            centre.unsqueeze(-1) + away, torch.stack([*midway, self.images_m[..., axis]], dim=-1)
        ], dim=-1)  # fmt: skip
        exists = self.is_object.unsqueeze(-1).repeat(1, 1, BY_OBJECT)
        exists[..., -3:] &= torch.cat([has_room, self.has_image.unsqueeze(-1)], dim=-1)
        kinds = torch.arange(BY_SIDES + BY_OBJECT, device=size.device)
        return Anchors(
            torch.cat([sides, beside.flatten(1)], dim=1),
            torch.cat([torch.ones_like(sides, dtype=torch.bool), exists.flatten(1)], dim=1),
            torch.cat([kinds[:BY_SIDES], kinds[BY_SIDES:].repeat(centre.shape[1])]),
        )

    def relations(self, axis: int, at_m: Float[Tensor, "rooms anchors"]) -> tuple[Tensor, ...]:
        """Features, along an axis, of the relations to the objects already placed and to the sides
        of the rectangle, and the gap to each object in metres, negative where they overlap."""
        size = self.size_m[:, axis].unsqueeze(1)
        offset = self.footprints_m[:, None, :, axis] - at_m.unsqueeze(-1)
        theirs = self.footprints_m[..., 2 + axis]
        total, difference = ((theirs + size) / 2).unsqueeze(1), ((theirs - size) / 2).unsqueeze(1)
        gap = offset.abs() - total
        offsets = torch.stack([offset, offset - difference, offset + difference], dim=-1)
        from_image = (self.images_m[:, None, :, axis] - at_m.unsqueeze(-1)).abs().unsqueeze(-1)
        near = (1 - from_image / from_image.new_tensor(NEAR_M)).clamp(min=0)
        relations = [
            ramps(gap.unsqueeze(-1), GAPS_M), ramps(offsets, OFFSETS_M),
            near * self.has_image[:, None, :, None],
        ]  # fmt: skip
        middle, extent = (self.rectangle_m[:, [at]] for at in (axis, 2 + axis))

        def to_sides(at_m: Tensor, size: Tensor) -> Tensor:
            to_middle = at_m - middle
            low_high = torch.stack([extent / 2 + to_middle, extent / 2 - to_middle], dim=-1)
            return low_high - size.unsqueeze(-1) / 2

        own, others = to_sides(at_m, size), to_sides(self.footprints_m[..., axis], theirs)
        # What stays free between a side and all furniture once this object stands.
        others = others.masked_fill(~self.is_object.unsqueeze(-1), torch.inf)
        nearest = F.pad(others, (0, 0, 0, 1), value=torch.inf).amin(dim=1, keepdim=True)
        sides = torch.cat([own, torch.minimum(own, nearest)], dim=-1)
        return torch.cat(relations, dim=-1), ramps(sides, GAPS_M), gap
