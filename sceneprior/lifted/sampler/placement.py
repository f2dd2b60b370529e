"""The distribution of an object's place, as a mixture around anchors: positions relative to the
room and to the objects already placed."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.boxes import QUARTERS, turn_boxes
from sceneprior.core.mixtures import FIRST_SCALE, LogisticMixture
from sceneprior.lifted.prototypes import PARTS, PosedRooms, turn_posed
from sceneprior.lifted.sampler.contents import MANY, reached
from sceneprior.lifted.sampler.frames import (
    gaps_to_sides_m,
    mirror_images,
    shared_extents,
    side_of,
    turn_places,
    turn_rectangles,
)

SHOWN = PARTS**3 + 3
"""Numbers that encode a look: its coarse grid and the logarithms of its extents."""
EMBEDDING = 16
"""Dimension of the embeddings of classes and of looks. All inputs of this module are small or
coarse, because exact sizes would identify a training room."""
WIDTH = 64
"""Width of the hidden layers."""
NARROW_M, WIDE_M = 0.03, 0.2
"""Scales in metres of narrow and wide logistics, for a network output of 0. Wide logistics are used
at one of the two anchors at each position given by the room, and at anchors `APART_M` from an
object."""
SHIFT_M = 0.3
"""Shift of an anchor in metres for a network output of 1."""
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
DRAWS, DENSER = 8, 4
"""Numbers of values drawn along each axis, and of the densest of them, whose first is taken.
Otherwise many unlikely anchors together would have enough weight that one of four chairs stands
apart."""
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


class Places(NamedTuple):
    """The distribution of the next object's centre (x, z) in each room. Tensors refer to the frame
    of that object (`frames.py`)."""

    placement: "Placement"
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
    images_m: Float[Tensor, "rooms objects 2"]
    """Mirror image (x, z) of each placed object of the same class; see `mirror_images`."""
    has_image: Bool[Tensor, "rooms objects"]
    quarters: Int[Tensor, " rooms"]
    """Quarter turns that take the room to the frame."""

    def rows(self, rows: Int[Tensor, " some"]) -> "Places":
        """The distribution in these rooms."""
        return Places(self.placement, *(part[rows] for part in self[1:]))

    def log_prob(self, place_m: Float[Tensor, "rooms 2"]) -> Float[Tensor, " rooms"]:
        """Log-densities of places in the rooms."""
        x, z = turn_places(place_m, self.quarters).split(1, dim=-1)
        return self._along_x().log_prob(x) + self._along_z(x[:, 0]).log_prob(z)

    def draw_x(
        self, uniform: Float[Tensor, "rooms tries draws 2"], dense: int
    ) -> Float[Tensor, "rooms tries"]:
        """Sample positions along the frames' x axis, the first `dense` ones from the denser part
        (`DRAWS`). `uniform` holds the random numbers to use, uniform in [0, 1)."""
        first, others = uniform.split([dense, uniform.shape[1] - dense], dim=1)
        along_x = self._along_x()
        every = along_x.denser(others[:, :, :1], 1)
        return torch.cat([along_x.denser(first, DENSER), every], dim=1)

    def draw(
        self, x: Float[Tensor, " rooms"], uniform: Float[Tensor, "rooms draws 2"], dense: bool
    ) -> Float[Tensor, "rooms 2"]:
        """Sample each place's z in its frame, given its `x` there, and return both turned to the
        room's axes. If `dense`, z is from the denser part, too. `uniform` holds the random numbers
        to use, uniform in [0, 1)."""
        numbers, kept = (uniform, DENSER) if dense else (uniform[:, :1], 1)
        z = self._along_z(x).denser(numbers.unsqueeze(1), kept)[:, 0]
        return turn_places(torch.stack([x, z], dim=-1), -self.quarters % QUARTERS)

    def _along_x(self) -> LogisticMixture:
        anchors = self._anchors(0)
        relations, sides, _ = self._relations(0, anchors.at_m)
        return self.placement.along_x(self, anchors, (relations,), sides)

    def _along_z(self, x: Float[Tensor, " rooms"]) -> LogisticMixture:
        anchors = self._anchors(1)
        relations_x, sides_x, gap_x = self._relations(0, x.unsqueeze(1))
        relations_z, sides_z, gap_z = self._relations(1, anchors.at_m)
        apart = ramps(torch.maximum(gap_x, gap_z).unsqueeze(-1), GAPS_M)
        least = torch.minimum(
            self.size_m.prod(dim=-1, keepdim=True), self.footprints_m[..., 2:].prod(dim=-1)
        )
        shared = gap_x.clamp(max=0) * gap_z.clamp(max=0) / least.clamp(min=1e-6).unsqueeze(1)
        shared = (shared * self.meets.unsqueeze(1)).clamp(max=1).unsqueeze(-1)
        # An object is near an image only if it is so along both axes.
        relations_z[..., -len(NEAR_M) :] *= relations_x[..., -1:]
        sides = torch.cat([sides_x.expand_as(sides_z), sides_z], dim=-1)
        return self.placement.along_z(
            self, anchors, (relations_x, relations_z, apart, shared.sqrt()), sides
        )

    def _anchors(self, axis: int) -> Anchors:
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

    def _relations(self, axis: int, at_m: Float[Tensor, "rooms anchors"]) -> tuple[Tensor, ...]:
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


class AxisScore(nn.Module):
    """Weights, shifts and scales of the anchors along an axis.

    The weight logit of an anchor is the output of a small network, which sums over the objects
    already placed, plus a linear function of the same features, whose coefficients are tables by
    class and by pair of classes. Within a few steps, the tables learn facts that the network alone
    would take ten times as long to learn, such as that nightstands stand adjacent to beds.
    """

    def __init__(self, classes: int, of_object: int, of_sides: int, dropout: float):
        super().__init__()
        self.pair_table = nn.Parameter(torch.zeros(classes, classes, of_object))
        self.side_table = nn.Parameter(torch.zeros(classes, of_sides))
        self.anchor_table = nn.Parameter(torch.zeros(classes, BY_SIDES + BY_OBJECT))
        self.relation = nn.Linear(of_object, WIDTH)
        self.own, self.there = nn.Linear(WIDTH, WIDTH), nn.Linear(WIDTH, WIDTH)
        self.pooled, self.sides = nn.Linear(WIDTH, WIDTH), nn.Linear(of_sides, WIDTH)
        self.anchor = nn.Embedding(BY_SIDES + BY_OBJECT, WIDTH)
        self.anchor_own = nn.Linear(WIDTH, WIDTH)
        self.dropout = nn.Dropout(dropout)
        self.out = nn.Linear(WIDTH, 3)
        scales_m = (
            [NARROW_M, WIDE_M] * (BY_SIDES // 2)
            + [NARROW_M] * (BY_OBJECT - 5) + [WIDE_M] * 2 + [NARROW_M] * 3
        )  # fmt: skip
        first = torch.tensor([math.log(scale_m / FIRST_SCALE) for scale_m in scales_m])
        self.first_log_scale: Tensor
        self.register_buffer("first_log_scale", first, persistent=False)
        with torch.no_grad():  # so that anchors start near their positions, equally likely
            self.anchor.weight *= 0.1
            self.out.weight *= 0.5
            self.out.bias.zero_()

    def forward(
        self,
        places: Places,
        anchors: Anchors,
        relations: tuple[Float[Tensor, " rooms #anchors objects _"], ...],
        sides: Float[Tensor, "rooms anchors features"],
    ) -> LogisticMixture:
        """The mixture along the axis of the `anchors`, by the neighbours at each of them.

        Args:
            relations: Features of the relations to the objects, in several tensors. A tensor that
                is the same for all anchors has size 1 along that axis, and precedes the others.
            sides: Features of the relations to the sides of the rectangle.
        """
        given = self.own(places.own).unsqueeze(1) + self.there(places.there)
        # Padding adds relu(-inf) = 0. The tensors of all anchors and objects are so large that each
        # pass over them takes time, so they are changed in place.
        given = given.masked_fill(~places.is_object.unsqueeze(-1), -torch.inf).unsqueeze(1)
        widths = [part.shape[-1] for part in relations]
        for part, weight in zip(relations, self.relation.weight.split(widths, 1), strict=True):
            given = (part @ weight.T).add_(given)
        pairs = given.add_(self.relation.bias).relu_()
        known = self.sides(sides) + self.anchor(anchors.kind)
        hidden = (
            self.pooled(pairs.sum(dim=2) / 2) + known + self.anchor_own(places.own).unsqueeze(1)
        )
        logit, shift, scale = self.out(self.dropout(torch.relu(hidden))).unbind(dim=-1)
        table = self.pair_table[places.label.unsqueeze(1), places.object_class]
        table = table * places.is_object.unsqueeze(-1)
        for part, weight in zip(relations, table.split(widths, dim=-1), strict=True):
            logit = logit + torch.einsum("raof,rof->ra", part, weight)
        logit = logit + torch.einsum("raf,rf->ra", sides, self.side_table[places.label])
        logit = logit + self.anchor_table[places.label][:, anchors.kind]
        means = anchors.at_m + SHIFT_M * shift
        return LogisticMixture.bounded(
            logit.masked_fill(~anchors.exists, -torch.inf),
            means.unsqueeze(-1),
            (scale + self.first_log_scale[anchors.kind]).unsqueeze(-1),
        )


class Placement(nn.Module):
    """The distribution of a footprint's centre (x, z) in the object's frame: p(x) p(z | x).

    Both factors are mixtures of logistics around anchors. The room gives anchors flush with a side
    of the rectangle, in the middle of the rectangle, and in the middle of the floor. Every object
    already placed gives anchors adjacent to it, flush with its sides, centred on it, apart from it,
    and midway between it and the sides of the rectangle, and one at its mirror image about the
    larger piece beside it. So an object can stand flush with a wall along one axis and adjacent to
    another object along the other. The weight of an anchor depends on the neighbours of an object
    at the anchor (`AxisScore`).

    Args:
        classes: Size of the label set.
        dropout: Dropout rate.
    """

    def __init__(self, classes: int, dropout: float):
        super().__init__()
        self.class_embedding = nn.Embedding(classes, EMBEDDING)
        self.look_embedding = nn.Linear(SHOWN, EMBEDDING)
        self.own = nn.Linear(2 * EMBEDDING + 6 + 2 * classes + 2 * MANY, WIDTH)
        self.there = nn.Linear(2 * EMBEDDING + QUARTERS + 4 + 4 * OF_GAP, WIDTH)
        self.dropout = nn.Dropout(dropout)
        self.along_x = AxisScore(classes, OF_OBJECT, OF_SIDES, dropout)
        # Given x, relations along both axes are known, and so are the gap between the footprints
        # and their overlap.
        self.along_z = AxisScore(classes, 2 * OF_OBJECT + OF_GAP + 1, 2 * OF_SIDES, dropout)

    def forward(
        self,
        label: Int[Tensor, " rooms"],
        look: Int[Tensor, " rooms"],
        size_m: Float[Tensor, "rooms 3"],
        bottom_m: Float[Tensor, " rooms"],
        rectangle_m: Float[Tensor, "rooms 4"],
        before: PosedRooms,
        counts: Float[Tensor, "rooms counts"],
        look_shown: Float[Tensor, "looks shown"],
        backs: Int[Tensor, " prototypes"],
    ) -> Places:
        """The distribution for an object of a class, look and size, given the rectangle (centre
        x, z, extents x, z), the objects already placed, and the counts of each class, placed and
        still to come.

        Args:
            look_shown: Encoding of every look.
            backs: Side of every prototype's back; see `side_of`.
        """
        back = side_of(look, backs)
        quarters = -back % QUARTERS
        rectangle_m, not_mirrored = turn_rectangles(rectangle_m, quarters), quarters < 0
        assert before.looks is not None
        looks = turn_posed(before.looks, quarters, not_mirrored)
        before = replace(before, boxes_m=turn_boxes(before.boxes_m, quarters), looks=looks)
        own_look = turn_posed(look[:, None], quarters, not_mirrored)[:, 0]
        size_m = torch.where((quarters % 2 == 1)[:, None], size_m.flip(-1), size_m)
        centre, extents = before.boxes_m.split(3, dim=-1)
        bottoms_m = centre[..., 1:2] - extents[..., 1:2] / 2
        backs_there = side_of(looks, backs)
        to_sides = ramps(torch.cat(gaps_to_sides_m(before.boxes_m, rectangle_m), dim=-1), GAPS_M)
        there = torch.cat([
            self.class_embedding(before.object_class), self.look_embedding(look_shown[looks]),
            torch.eye(QUARTERS).to(extents)[backs_there], extents, bottoms_m, to_sides,
        ], dim=-1)  # fmt: skip
        # The number of objects of its class, placed and in all: four chairs stand in pairs.
        placed, coming = counts.unflatten(-1, (2, -1)).gather(
            -1, label[:, None, None].expand(-1, 2, 1)
        ).unbind(dim=1)  # fmt: skip
        alike = reached(torch.cat([placed, placed + coming], dim=-1))
        own = torch.cat([
            self.class_embedding(label), self.look_embedding(look_shown[own_look]),
            size_m, bottom_m.unsqueeze(-1), rectangle_m[:, 2:] / 4, counts, alike.flatten(1),
        ], dim=-1)  # fmt: skip
        own_box = torch.cat([centre.new_zeros(len(label), 3), size_m], dim=-1).unsqueeze(1)
        own_box[:, 0, 1] = bottom_m + size_m[:, 1] / 2
        # True if the two overlap in height; x and z are set to 0, because they do not matter.
        level = centre * torch.tensor([0.0, 1.0, 0.0]).to(centre)
        meets = shared_extents(own_box, torch.cat([level, extents], dim=-1))[..., 1] > 0
        images_m, has_image = mirror_images(before, label, backs_there)
        return Places(
            self, label, before.object_class,
            self.dropout(torch.relu(self.own(own))), self.dropout(torch.relu(self.there(there))),
            size_m[:, ::2], rectangle_m, before.boxes_m[..., [0, 2, 3, 5]], before.is_object,
            meets, images_m, has_image, quarters,
        )  # fmt: skip
