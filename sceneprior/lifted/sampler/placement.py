"""The distribution of an object's place, as a choice between places relative to the room and to the
objects already placed."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from sceneprior.core.boxes import QUARTERS
from sceneprior.core.mixtures import FIRST_SCALE, LogisticMixture
from sceneprior.lifted.prototypes import PARTS
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.frames import into_frames, side_of, turn_rectangles
from sceneprior.lifted.sampler.places import (
    BY_OBJECT,
    BY_SIDES,
    GAPS_M,
    OF_OBJECT,
    OF_SIDES,
    Anchors,
    Places,
    ramps,
)
from sceneprior.lifted.sampler.rooms import gaps_to_sides_m, shared_extents

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


class Placement(nn.Module):
    """The distribution of a footprint's centre (x, z) in the object's frame: p(x) p(z | x).

    Both factors are mixtures of logistics around anchors. The room gives anchors flush with a side
    of the rectangle, in the middle of the rectangle, and in the middle of the floor. Every object
    already placed gives anchors adjacent to it, flush with its sides, centred on it, and apart from
    it. So an object can stand flush with a wall along one axis and adjacent to another object along
    the other. The weight of an anchor depends on the neighbours of an object at the anchor
    (`AxisScore`).

    Args:
        classes: Size of the label set.
        dropout: Dropout rate.
    """

    def __init__(self, classes: int, dropout: float):
        super().__init__()
        self.class_embedding = nn.Embedding(classes, EMBEDDING)
        self.look_embedding = nn.Linear(SHOWN, EMBEDDING)
        self.own = nn.Linear(2 * EMBEDDING + 6 + 2 * classes, WIDTH)
        self.there = nn.Linear(2 * EMBEDDING + QUARTERS + 4 + 2 * OF_SIDES, WIDTH)
        self.dropout = nn.Dropout(dropout)
        self.along_x = AxisScore(classes, OF_OBJECT, OF_SIDES, dropout)
        # Given x, relations along both axes are known, and so is the overlap of the footprints.
        self.along_z = AxisScore(classes, 2 * OF_OBJECT + 1, 2 * OF_SIDES, dropout)

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
        before, rectangle_m = into_frames(before, back), turn_rectangles(rectangle_m, quarters)
        looks = before.looks
        assert looks is not None
        own_look = into_frames(_alone(label, look, size_m), back).looks
        assert own_look is not None
        size_m = torch.where((quarters % 2 == 1)[:, None], size_m.flip(-1), size_m)
        centre, extents = before.boxes_m.split(3, dim=-1)
        bottoms_m = centre[..., 1:2] - extents[..., 1:2] / 2
        to_sides = ramps(torch.cat(gaps_to_sides_m(before.boxes_m, rectangle_m), dim=-1), GAPS_M)
        there = torch.cat([
            self.class_embedding(before.object_class), self.look_embedding(look_shown[looks]),
            torch.eye(QUARTERS).to(extents)[side_of(looks, backs)], extents, bottoms_m, to_sides,
        ], dim=-1)  # fmt: skip
        own = torch.cat([
            self.class_embedding(label), self.look_embedding(look_shown[own_look[:, 0]]),
            size_m, bottom_m.unsqueeze(-1), rectangle_m[:, 2:] / 4, counts,
        ], dim=-1)  # fmt: skip
        own_box = torch.cat([centre.new_zeros(len(label), 3), size_m], dim=-1).unsqueeze(1)
        own_box[:, 0, 1] = bottom_m + size_m[:, 1] / 2
        # True if the two overlap in height; x and z are set to 0, because they do not matter.
        level = centre * torch.tensor([0.0, 1.0, 0.0]).to(centre)
        meets = shared_extents(own_box, torch.cat([level, extents], dim=-1))[..., 1] > 0
        return Places(
            self.along_x, self.along_z, label, before.object_class,
            self.dropout(torch.relu(self.own(own))), self.dropout(torch.relu(self.there(there))),
            size_m[:, ::2], rectangle_m, before.boxes_m[..., [0, 2, 3, 5]], before.is_object,
            meets, quarters,
        )  # fmt: skip


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
            [NARROW_M, WIDE_M] * (BY_SIDES // 2) + [NARROW_M] * (BY_OBJECT - 2) + [WIDE_M] * 2
        )
        first = torch.tensor([math.log(scale_m / FIRST_SCALE) for scale_m in scales_m])
        self.first_log_scale: Tensor
        self.register_buffer("first_log_scale", first, persistent=False)
        with torch.no_grad():  # so that anchors start near their positions, equally likely
            self.anchor.weight *= 0.1
            self.out.weight *= 0.5
            self.out.bias.zero_()

    def forward(self, places: Places, anchors: Anchors) -> LogisticMixture:
        """The mixture along the axis of the `anchors`."""
        given = self.own(places.own).unsqueeze(1) + self.there(places.there)
        # Padding adds relu(-inf) = 0. The tensors of all anchors and objects are so large that each
        # pass over them takes time, so they are changed in place.
        given = given.masked_fill(~places.is_object.unsqueeze(-1), -torch.inf).unsqueeze(1)
        widths = [part.shape[-1] for part in anchors.relations]
        for part, weight in zip(
            anchors.relations, self.relation.weight.split(widths, 1), strict=True
        ):
            given = (part @ weight.T).add_(given)
        pairs = given.add_(self.relation.bias).relu_()
        known = self.sides(anchors.sides) + self.anchor(anchors.kind)
        hidden = (
            self.pooled(pairs.sum(dim=2) / 2) + known + self.anchor_own(places.own).unsqueeze(1)
        )
        logit, shift, scale = self.out(self.dropout(torch.relu(hidden))).unbind(dim=-1)
        table = self.pair_table[places.label.unsqueeze(1), places.object_class]
        table = table * places.is_object.unsqueeze(-1)
        for part, weight in zip(anchors.relations, table.split(widths, dim=-1), strict=True):
            logit = logit + torch.einsum("raof,rof->ra", part, weight)
        logit = logit + torch.einsum("raf,rf->ra", anchors.sides, self.side_table[places.label])
        logit = logit + self.anchor_table[places.label][:, anchors.kind]
        means = anchors.at_m + SHIFT_M * shift
        return LogisticMixture.bounded(
            logit.masked_fill(~anchors.exists, -torch.inf),
            means.unsqueeze(-1),
            (scale + self.first_log_scale[anchors.kind]).unsqueeze(-1),
        )


def _alone(
    label: Int[Tensor, " rooms"], look: Int[Tensor, " rooms"], size_m: Float[Tensor, "rooms 3"]
) -> PosedRooms:
    """Rooms with one object each, at the origin."""
    boxes_m = torch.cat([torch.zeros_like(size_m), size_m], dim=-1).unsqueeze(1)
    is_object = torch.ones_like(label, dtype=torch.bool).unsqueeze(1)
    return PosedRooms(label.unsqueeze(1), is_object, boxes_m, looks=look.unsqueeze(1))
