"""The distribution of an object's place, as a mixture around anchors: positions relative to the
room and to the objects already placed."""

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from sceneprior.core.boxes import QUARTERS, turn_boxes
from sceneprior.core.mixtures import FIRST_SCALE, LogisticMixture
from sceneprior.lifted.prototypes import PARTS, PosedRooms, turn_posed
from sceneprior.lifted.sampler.anchors import (
    BY_OBJECT,
    BY_SIDES,
    GAPS_M,
    NEAR_M,
    OF_GAP,
    OF_OBJECT,
    OF_SIDES,
    Anchors,
    Surroundings,
    ramps,
)
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
DRAWS, DENSER = 8, 4
"""Sampling from the denser part of a distribution draws `DRAWS` values along each axis and takes
the first of the `DENSER` ones of highest density. Otherwise many unlikely anchors together would
have enough weight that one of four chairs stands away from the table."""


class Places(NamedTuple):
    """The distribution of the next object's centre (x, z) in each room. Tensors refer to the frame
    of that object (`frames.py`)."""

    placement: "Placement"
    around: Surroundings
    label: Int[Tensor, " rooms"]
    object_class: Int[Tensor, "rooms objects"]
    own: Float[Tensor, "rooms width"]
    there: Float[Tensor, "rooms objects width"]
    meets: Bool[Tensor, "rooms objects"]
    """True for placed objects whose vertical extent overlaps with that of the object to be
    placed."""
    quarters: Int[Tensor, " rooms"]
    """Quarter turns that take the room to the frame."""

    def rows(self, rows: Int[Tensor, " some"]) -> "Places":
        """The distribution in these rooms."""
        parts = (part[rows] for part in self[2:])
        return Places(self.placement, self.around.rows(rows), *parts)

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
        anchors = self.around.anchors(0)
        relations, sides, _ = self.around.relations(0, anchors.at_m)
        return self.placement.along_x(self, anchors, (relations,), sides)

    def _along_z(self, x: Float[Tensor, " rooms"]) -> LogisticMixture:
        anchors = self.around.anchors(1)
        relations_x, sides_x, gap_x = self.around.relations(0, x.unsqueeze(1))
        relations_z, sides_z, gap_z = self.around.relations(1, anchors.at_m)
        apart = ramps(torch.maximum(gap_x, gap_z).unsqueeze(-1), GAPS_M)
        sizes_m = self.around.size_m, self.around.footprints_m[..., 2:]
        own_m2, theirs_m2 = (size_m.prod(dim=-1) for size_m in sizes_m)
        least = torch.minimum(own_m2.unsqueeze(1), theirs_m2)
        shared = gap_x.clamp(max=0) * gap_z.clamp(max=0) / least.clamp(min=1e-6).unsqueeze(1)
        shared = (shared * self.meets.unsqueeze(1)).clamp(max=1).unsqueeze(-1)
        # An object is near an image only if it is so along both axes.
        relations_z[..., -len(NEAR_M) :] *= relations_x[..., -1:]
        sides = torch.cat([sides_x.expand_as(sides_z), sides_z], dim=-1)
        return self.placement.along_z(
            self, anchors, (relations_x, relations_z, apart, shared.sqrt()), sides
        )


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
        relations: tuple[Float[Tensor, "rooms #anchors objects _"], ...],
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
        given = given.masked_fill(~places.around.is_object.unsqueeze(-1), -torch.inf).unsqueeze(1)
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
        table = table * places.around.is_object.unsqueeze(-1)
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
        footprints_m = before.boxes_m[..., [0, 2, 3, 5]]
        around = Surroundings(
            size_m[:, ::2], rectangle_m, footprints_m, before.is_object, images_m, has_image
        )
        return Places(
            self, around, label, before.object_class,
            self.dropout(torch.relu(self.own(own))), self.dropout(torch.relu(self.there(there))),
            meets, quarters,
        )  # fmt: skip
