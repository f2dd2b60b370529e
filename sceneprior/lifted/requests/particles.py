"""Particles of sequential Monte Carlo: partly furnished rooms, several for each requested room."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.lifted.requests.plans import RoomPlan
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.draw import read_rooms
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.reading import Reading

PARTICLES = 6
"""Particles per room. With more, an attempt meets rarer wishes, in proportionally more time."""


@dataclass
class Particles:
    """Particles of several rooms; room r has `PARTICLES` rows, the first of which is row
    r * `PARTICLES`."""

    plans: Sequence[RoomPlan]
    rooms: PosedRooms
    number: Int[Tensor, " rows"]
    """Objects placed so far."""
    upcoming: Int[Tensor, "rows slots"]
    """Class to place in each step; 0 for none."""
    rectangle_m: Float[Tensor, "rows 4"]
    """Bounding rectangle of each room's floor."""
    alive: Bool[np.ndarray, " rows"]
    """False for particles in which an object found no place, until they are replaced."""

    @property
    def looks(self) -> Int[Tensor, "rows slots"]:
        """Look of each object."""
        assert self.rooms.looks is not None
        return self.rooms.looks

    def plan(self, row: int) -> RoomPlan:
        """The plan of a particle's room."""
        return self.plans[row // PARTICLES]

    def rows_of(self, room: int) -> np.ndarray:
        """Rows of a room's particles."""
        return np.arange(room * PARTICLES, (room + 1) * PARTICLES)

    def read(self, sampler: RoomSampler, rows: Int[Tensor, " some"], step: int) -> Reading:
        """The outputs of the sampler's encoder for some particles before a step."""
        return read_rooms(
            sampler, self.rooms.changed(lambda part: part[rows]), self.number[rows],
            self.rectangle_m[rows], self.upcoming[rows, step:],
        )  # fmt: skip

    def place(self, row: int, label: int, look: int, box_m: Float[Tensor, "6"]) -> None:
        """Add an object to a particle."""
        at = row, int(self.number[row])
        self.rooms.object_class[at], self.rooms.is_object[at] = label, True
        self.rooms.boxes_m[at], self.looks[at] = box_m, look
        self.number[row] += 1

    def replace_dead(self, room: int, draws: np.random.Generator) -> None:
        """Replace each dead particle of a room by a copy of a random living one."""
        rows = self.rows_of(room)
        dead, living = rows[~self.alive[rows]], rows[self.alive[rows]]
        chosen = living[draws.integers(len(living), size=PARTICLES)[: len(dead)]]
        for part in (
            self.rooms.object_class, self.rooms.is_object, self.rooms.boxes_m, self.looks,
            self.number,
        ):  # fmt: skip
            part[torch.from_numpy(dead)] = part[torch.from_numpy(chosen)]
        self.alive[dead] = True


def start_particles(
    sampler: RoomSampler, plans: Sequence[RoomPlan], given: PosedRooms
) -> Particles:
    """Particles that contain the given objects alone.

    Args:
        given: One room with looks, padded to `sampler.max_objects`.
    """
    rows = len(plans) * PARTICLES
    assert given.looks is not None and given.is_object.shape == (1, sampler.max_objects)
    rooms = given.changed(lambda part: part.repeat_interleave(rows, dim=0))
    upcoming = [
        F.pad(torch.tensor(plan.upcoming).long(), (0, sampler.max_objects - len(plan.upcoming)))
        for plan in plans
    ]
    rectangles = [torch.from_numpy(plan.shape.floor.rectangle_m).float() for plan in plans]
    return Particles(
        plans, rooms, rooms.is_object.sum(dim=1),
        torch.stack(upcoming).repeat_interleave(PARTICLES, dim=0),
        torch.stack(rectangles).repeat_interleave(PARTICLES, dim=0),
        np.ones(rows, dtype=bool),
    )  # fmt: skip
