"""Training rooms of the sampler: the lifted objects of each room, with their looks."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sceneprior.core.classes import label_set
from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.prototypes import PosedRooms, Prototypes
from sceneprior.lifted.sampler.frames import (
    FRAME_M,
    GRAZE_M,
    OUTWARD,
    rectangle_sides,
    rectangles_of,
    shared_extents,
)
from sceneprior.lifted.sampler.orientation import FACING, gaps_to_walls, orient

LOOSELY = 2.0
"""Range of the random offset of log footprints in `large_first`."""
SURE_M = 0.03
"""Maximum standard error of a wall that replaces a side of a training room's rectangle."""
AT_WALL_M = 0.45
"""Maximum gap between furniture and such a wall; drawn rooms with larger gaps are drawn again
(`draw.py`)."""
PLAUSIBLE_SHARE = 0.2
"""Share of the training rooms with both classes in which the two must intersect for intersections
to count as intended. Lifted boxes of chairs intersect each other in a seventh of the rooms, true
boxes in none."""


class SamplerRooms:
    """Rooms as unordered sets of objects with class, box and look; one row per room, without turned
    copies.

    Objects without a label, and objects that are visible in no view, are left out.

    Args:
        lifted: A split, with its shapes.
    """

    room_ids: tuple[str, ...]
    """Ids of the rows of the prior's latents, turned copies included."""
    masks = None
    """None, so that batches are made in the training process (see `RoomDataset`)."""

    def __init__(self, lifted: LiftedDataset):
        self.room_ids, self.label_set = lifted.room_ids, lifted.label_set
        self.plain_ids = tuple(lifted.plain_ids)
        self._lifted = lifted
        self.prototypes: Prototypes
        self.rooms: PosedRooms
        self.to_walls_m: Float[Tensor, "rooms objects 4"]
        self.backs: Int[Tensor, " prototypes"]
        self.confidence: Float[Tensor, " prototypes"]

    def assign_prototypes(
        self, prototypes: Prototypes, backs: Int[Tensor, " prototypes"] | None = None
    ) -> "SamplerRooms":
        """Set `rooms`, in which every object has a look, and return this data set.

        Only common prototypes are used, since rare prototypes are often errors of lifting. `backs`
        are the sides of their backs; if they are not given, they are found, too (`orient`).
        """
        lifted, prototypes = self._lifted, prototypes.common_alone()
        boxes_m = np.hstack(lifted.boxes[:2])
        looks, errors = lifted.posed_prototypes(prototypes)
        rows = np.split(np.arange(len(looks)), np.cumsum(lifted.counts)[:-1])
        kept = [torch.from_numpy(row[looks[row] >= 0]) for row in rows]

        def padded(values: np.ndarray) -> Tensor:
            return _padded([torch.from_numpy(values)[row] for row in kept])

        self.prototypes = prototypes
        self.rooms = PosedRooms(
            object_class=padded(lifted.object_classes),
            is_object=padded(np.ones(len(looks), dtype=bool)),
            boxes_m=padded(boxes_m.astype(np.float32)),
            room_ids=self.plain_ids,
            looks=padded(looks),
        )
        walls = [
            _walls_of(*each)
            for each in zip(lifted.walls, rectangles_of(self.rooms).numpy(), strict=True)
        ]
        self.rooms = replace(self.rooms, walls_m=torch.tensor(walls, dtype=torch.float32))
        to_walls = [
            torch.from_numpy(gaps_to_walls(boxes_m[row.numpy()], walls))
            for row, walls in zip(kept, lifted.walls, strict=True)
        ]
        self.to_walls_m = _padded(to_walls)
        self.backs, self.confidence, posed = orient(
            self.rooms, self.to_walls_m, padded(errors), prototypes,
            label_set(self.label_set), backs,
        )  # fmt: skip
        self.rooms = replace(self.rooms, looks=posed)
        return self

    def __len__(self) -> int:
        return len(self.plain_ids)

    def to(self, device: torch.device | str) -> "SamplerRooms":
        """Move all rooms to `device`, on which batches are then assembled."""
        self.rooms = self.rooms.to(device)
        return self

    def __getitems__(self, draws: list[tuple[int, int]]) -> PosedRooms:
        """A batch of rows; each draw is (row, epoch). A draw of epoch `BLANK` gives an empty room,
        which does not contribute to the loss."""
        shown = torch.tensor([epoch >= 0 for _, epoch in draws])
        rows = [row for row, _ in draws]
        rooms = self.rooms.changed(lambda part: part[rows])
        rooms = rooms.only(shown.to(rooms.is_object.device)[:, None])
        return replace(rooms, room_ids=tuple(self.plain_ids[row] for row in rows))

    def may_meet(self, classes: int) -> Bool[Tensor, "classes classes"]:
        """Pairs of classes that intersect in at least `PLAUSIBLE_SHARE` of the rooms with both,
        such as a chair and its table; symmetric."""
        together = torch.zeros(2, classes, classes, dtype=torch.int64)
        for row in range(len(self)):
            here = self.rooms.is_object[row]
            label, boxes_m = self.rooms.object_class[row, here], self.rooms.boxes_m[row, here]
            first, second = torch.triu_indices(len(label), len(label), 1)
            shared = shared_extents(boxes_m[first], boxes_m[second]).amin(dim=-1) > GRAZE_M
            for number, pairs in enumerate((torch.ones_like(shared), shared)):
                found = torch.zeros(classes, classes, dtype=torch.bool)
                found[label[first[pairs]], label[second[pairs]]] = True
                together[number] += found | found.T
        both, meeting = together
        return (both > 0) & (meeting >= PLAUSIBLE_SHARE * both)


def _walls_of(walls: Sequence[Wall], rectangle_m: np.ndarray) -> list[float]:
    """One row of `PosedRooms.walls_m`: for each side of the rectangle around the furniture, the
    nearest wall that faces this side and overlaps with it along its direction."""
    middle, half = rectangle_m[:2], rectangle_m[2:] / 2
    found = []
    for outwards in OUTWARD:
        side_m = middle @ outwards + half @ abs(outwards)
        near = []
        for wall in walls:
            if wall.error_m > SURE_M or wall.inward @ outwards > -FACING:
                continue
            ends = np.sort((np.stack([wall.start_m, wall.end_m]) - middle) @ (1 - abs(outwards)))
            across = half @ (1 - abs(outwards))
            wall_m = (wall.start_m + wall.end_m) @ outwards / 2
            if (
                ends[0] < across
                and ends[1] > -across
                and -GRAZE_M * 2 < wall_m - side_m < AT_WALL_M
            ):
                near.append(wall_m)
        found.append(min(near, key=lambda wall_m: abs(wall_m - side_m), default=math.nan))
    return found


def frames_of(rooms: PosedRooms, generator: torch.Generator) -> Float[Tensor, "rooms 4"]:
    """`rectangles_of` with each side moved outwards: to the wall if known, otherwise by the
    absolute value of a normal random number.

    The exact extents would reveal when a room is complete, since the last object touches them, and
    sampled furniture never fits a rectangle exactly. So noise of standard deviation `FRAME_M` is
    added.
    """
    rectangle_m = rectangles_of(rooms)
    out = FRAME_M * torch.randn(len(rectangle_m), 4, generator=generator).abs().to(rectangle_m)
    low, high = rectangle_sides(rectangle_m)
    if rooms.walls_m is not None:
        sides = torch.cat([-low, high], dim=-1)
        gaps = (rooms.walls_m[:, [1, 0, 3, 2]] - sides).clamp(min=0)
        out = gaps.where(gaps.isfinite(), out)
    low, high = low - out[:, :2], high + out[:, 2:]
    return torch.cat([(low + high) / 2, high - low], dim=-1)


def shuffled(rooms: PosedRooms, generator: torch.Generator) -> PosedRooms:
    """Every room's objects in a random order, followed by its padding."""
    tickets = torch.rand(rooms.is_object.shape, generator=generator).to(rooms.boxes_m.device)
    return rooms.take(tickets.masked_fill(~rooms.is_object, 2.0).argsort(dim=1))


def large_first(
    rooms: PosedRooms,
    footprints_m2: Float[Tensor, " classes"],
    uniform: Float[Tensor, "rooms objects"],
) -> Int[Tensor, "rooms objects"]:
    """A random order in which classes with large footprints tend to come first, and large objects
    of a class before its small ones; padding comes last.

    Now and then, a class or an object comes before one with up to exp(`LOOSELY`) times its
    footprint, so that the network also learns from rooms in which only small objects are given.
    `uniform` holds random numbers in [0, 1).
    """
    label, late = rooms.object_class, LOOSELY * uniform
    tickets = late - footprints_m2.log()[label]
    order = tickets.masked_fill(label == 0, torch.inf).argsort(dim=1)
    by_size = (late - rooms.boxes_m[..., [3, 5]].log().sum(dim=-1)).argsort(dim=1)
    # Each class has the same places in the order, which its objects take by size.
    places = label.gather(1, order).argsort(dim=1, stable=True)
    objects = by_size.gather(1, label.gather(1, by_size).argsort(dim=1, stable=True))
    return torch.empty_like(order).scatter(1, places, objects)


def _padded(rows: list[Tensor]) -> Tensor:
    """The rows as one tensor, with room for one object at least."""
    padded = pad_sequence(rows, batch_first=True)
    return padded if padded.shape[1] else padded.new_zeros(len(rows), 1, *padded.shape[2:])
