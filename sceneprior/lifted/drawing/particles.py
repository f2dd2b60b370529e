"""Particles of sequential Monte Carlo: partly furnished rooms, one or several for each room."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.lifted.drawing.plans import RoomPlans, read_rooms
from sceneprior.lifted.sampler.encoder_state import EncoderState
from sceneprior.lifted.sampler.network import RoomSampler


class Particles:
    """Particles of several rooms; room r has `each` rows, the first of which is row r * `each`.

    Args:
        plans: The rooms' plans; all particles start with the given objects.
        each: Number of particles of a room.
    """

    def __init__(self, plans: RoomPlans, each: int):
        self.plans, self.each = plans, each
        self.room = torch.arange(len(plans.shapes)).repeat_interleave(each)
        self.rooms = plans.rooms.changed(lambda part: part[self.room])
        assert self.rooms.looks is not None
        self.looks = self.rooms.looks
        self.number = self.rooms.is_object.sum(dim=1)
        """Objects placed so far."""
        self.alive = torch.ones_like(self.number, dtype=torch.bool)
        """False for particles in which an object found no place, until they are replaced."""

    def rows_of(self, room: int) -> slice:
        """Rows of a room's particles."""
        return slice(room * self.each, (room + 1) * self.each)

    def read(self, sampler: RoomSampler, rows: Int[Tensor, " some"], step: int) -> EncoderState:
        """The outputs of the sampler's encoder for some particles before a step."""
        room = self.room[rows]
        return read_rooms(
            sampler, self.rooms.changed(lambda part: part[rows]), self.number[rows],
            self.plans.rectangle_m[room], self.plans.upcoming[room, step:],
        )  # fmt: skip

    def place(
        self,
        rows: Int[Tensor, " some"],
        label: Int[Tensor, " some"],
        look: Int[Tensor, " some"],
        boxes_m: Float[Tensor, "some 6"],
    ) -> None:
        """Add an object to each of some particles."""
        at = rows, self.number[rows]
        self.rooms.object_class[at], self.rooms.is_object[at] = label, True
        self.rooms.boxes_m[at], self.looks[at] = boxes_m, look
        self.number[rows] += 1

    def replace_dead(self, room: int, draws: np.random.Generator) -> None:
        """Replace each dead particle of a room by a copy of a random living one."""
        rows = torch.arange(len(self.room))[self.rows_of(room)]
        dead, living = rows[~self.alive[rows]], rows[self.alive[rows]]
        chosen = living[torch.from_numpy(draws.integers(len(living), size=len(dead)))]
        for part in (
            self.rooms.object_class, self.rooms.is_object, self.rooms.boxes_m, self.looks,
            self.number,
        ):  # fmt: skip
            part[dead] = part[chosen]
        self.alive[dead] = True


def steps_of(plans: RoomPlans) -> Sequence[int]:
    """The steps in which an object comes in some room."""
    return range(int((plans.upcoming != 0).sum(dim=1).max()) if len(plans.shapes) else 0)
