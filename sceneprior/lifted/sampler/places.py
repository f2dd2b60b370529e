"""Places of the next object, as mixtures around anchors: positions relative to the room and to the
objects already placed."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.boxes import QUARTERS
from sceneprior.core.mixtures import LogisticMixture
from sceneprior.lifted.sampler.frames import turn_places

BY_SIDES = 8
"""Number of anchors along an axis given by the room: a narrow and a wide one at each of four
positions. These are flush with the lower side of the rectangle, flush with its upper side, in its
middle, and at the origin, which is the middle of the floor."""
BY_OBJECT = 7
"""Number of anchors along an axis per object already placed: adjacent before it, flush with its
lower side, centred, flush with its upper side, adjacent behind it, and `APART_M` before and behind
it."""
APART_M = 0.4
"""Gap between an object and the two anchors apart from it."""
SHARPNESS, SPREAD = 1.5, 0.7
"""Sampling raises the weights of anchors to the power `SHARPNESS` and multiplies the scales by
`SPREAD`, because distributions learnt from a few hundred rooms are broader than those of the
rooms."""
GAPS_M = (-0.4, -0.15, -0.05, 0.0, 0.05, 0.15, 0.4, 1.0, 2.0)
"""Knots of `ramps` for gaps; negative gaps are overlaps."""
OFFSETS_M = (-1.5, -0.7, -0.3, -0.1, -0.03, 0.03, 0.1, 0.3, 0.7, 1.5)
"""Knots of `ramps` for offsets of centres and sides."""
OF_GAP, OF_OFFSET = len(GAPS_M) - 1, len(OFFSETS_M) - 1
OF_OBJECT, OF_SIDES = OF_GAP + 3 * OF_OFFSET, 2 * OF_GAP
"""Number of features, along an axis, of the relation to an object, and of the relations to the two
sides of the rectangle."""


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
    """Candidate positions of an object along an axis, with features of the neighbours that it would
    have at each of them."""

    at_m: Float[Tensor, "rooms anchors"]
    exists: Bool[Tensor, "rooms anchors"]
    """False for the anchors of padding."""
    kind: Int[Tensor, " anchors"]
    """0 to 7 for anchors given by the room, 8 to 14 for anchors of an object."""
    relations: tuple[Float[Tensor, "rooms #anchors objects _"], ...]
    """Features of the relations to the objects, in several tensors. A tensor that is the same for
    all anchors has size 1 along that axis, and precedes the others."""
    sides: Float[Tensor, "rooms anchors features"]


class Places(NamedTuple):
    """The distribution of the next object's centre (x, z) in each room. Tensors refer to the frame
    of that object (`frames.py`)."""

    along_x: "Callable[[Places, Anchors], LogisticMixture]"
    along_z: "Callable[[Places, Anchors], LogisticMixture]"
    label: Int[Tensor, " rooms"]
    object_class: Int[Tensor, "rooms objects"]
    own: Float[Tensor, "rooms width"]
    there: Float[Tensor, "rooms objects width"]
    size_m: Float[Tensor, "rooms 2"]
    rectangle_m: Float[Tensor, "rooms 4"]
    footprints_m: Float[Tensor, "rooms objects 4"]
    """Centre x, z and extents x, z of the objects already placed."""
    is_object: Bool[Tensor, "rooms objects"]
    meets: Bool[Tensor, "rooms objects"]
    """True for placed objects whose vertical extent overlaps with that of the object to be
    placed."""
    quarters: Int[Tensor, " rooms"]
    """Quarter turns that take the room to the frame."""

    def rows(self, rows: Int[Tensor, " some"]) -> "Places":
        """The distribution in these rooms."""
        return Places(self.along_x, self.along_z, *(part[rows] for part in self[2:]))

    def log_prob(self, place_m: Float[Tensor, "rooms 2"]) -> Float[Tensor, " rooms"]:
        """Log-densities of places in the rooms."""
        x, z = turn_places(place_m, self.quarters).split(1, dim=-1)
        return self._along_x().log_prob(x) + self._along_z(x[:, 0]).log_prob(z)

    def draw_x(self, uniform: Float[Tensor, "rooms tries 2"]) -> Float[Tensor, "rooms tries"]:
        """Sample positions along the frames' x axis. `uniform` holds the random numbers to use."""
        return _sharpened(self._along_x()).drawn(uniform[..., 0], uniform[..., 1:])[..., 0]

    def draw(
        self, x: Float[Tensor, " rooms"], uniform: Float[Tensor, "rooms 2"]
    ) -> Float[Tensor, "rooms 2"]:
        """Sample each place's z in its frame, given its `x` there, and return both turned to the
        room's axes. `uniform` holds the random numbers to use, uniform in [0, 1)."""
        z = _sharpened(self._along_z(x)).draw(uniform[:, 0], uniform[:, 1:])[:, 0]
        return turn_places(torch.stack([x, z], dim=-1), -self.quarters % QUARTERS)

    def _along_x(self) -> LogisticMixture:
        at_m, exists, kind = self._anchors(0)
        relations, sides, _ = self._relations(0, at_m)
        return self.along_x(self, Anchors(at_m, exists, kind, (relations,), sides))

    def _along_z(self, x: Float[Tensor, " rooms"]) -> LogisticMixture:
        at_m, exists, kind = self._anchors(1)
        relations_x, sides_x, overlap_x = self._relations(0, x.unsqueeze(1))
        relations_z, sides_z, overlap_z = self._relations(1, at_m)
        least = torch.minimum(
            self.size_m.prod(dim=-1, keepdim=True), self.footprints_m[..., 2:].prod(dim=-1)
        )
        shared = overlap_x * overlap_z / least.clamp(min=1e-6).unsqueeze(1)
        shared = (shared * self.meets.unsqueeze(1)).clamp(max=1).unsqueeze(-1)
        sides = torch.cat([sides_x.expand_as(sides_z), sides_z], dim=-1)
        relations = (relations_x, relations_z, shared.sqrt())
        return self.along_z(self, Anchors(at_m, exists, kind, relations, sides))

    def _anchors(self, axis: int) -> tuple[Tensor, Tensor, Tensor]:
        """`at_m`, `exists` and `kind` of `Anchors` along x (0) or z (1)."""
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
        beside = (centre.unsqueeze(-1) + away).flatten(1)
        theirs = self.is_object.repeat_interleave(BY_OBJECT, dim=1)
        kinds = torch.arange(BY_SIDES + BY_OBJECT, device=size.device)
        return (
            torch.cat([sides, beside], dim=1),
            torch.cat([torch.ones_like(sides, dtype=torch.bool), theirs], dim=1),
            torch.cat([kinds[:BY_SIDES], kinds[BY_SIDES:].repeat(centre.shape[1])]),
        )

    def _relations(self, axis: int, at_m: Float[Tensor, "rooms anchors"]) -> tuple[Tensor, ...]:
        """Features, along an axis, of the relations to the objects already placed and to the sides
        of the rectangle, and the overlap with each object in metres."""
        size = self.size_m[:, axis].unsqueeze(1)
        offset = self.footprints_m[:, None, :, axis] - at_m.unsqueeze(-1)
        theirs = self.footprints_m[..., 2 + axis]
        total, difference = ((theirs + size) / 2).unsqueeze(1), ((theirs - size) / 2).unsqueeze(1)
        gap = offset.abs() - total
        offsets = torch.stack([offset, offset - difference, offset + difference], dim=-1)
        relations = [ramps(gap.unsqueeze(-1), GAPS_M), ramps(offsets, OFFSETS_M)]
        middle, extent = (self.rectangle_m[:, [at]] for at in (axis, 2 + axis))
        to_middle = at_m - middle
        sides = (
            torch.stack([extent / 2 + to_middle, extent / 2 - to_middle], dim=-1)
            - size[..., None] / 2
        )
        overlap = (-gap).clamp(min=0)
        return torch.cat(relations, dim=-1), ramps(sides, GAPS_M), overlap


def _sharpened(mixture: LogisticMixture) -> LogisticMixture:
    """The mixture that is sampled from; see `SHARPNESS`."""
    return LogisticMixture(
        SHARPNESS * mixture.weight_logits, mixture.means, mixture.log_scales + math.log(SPREAD)
    )
