"""Likelihood of rooms, in a random order of their objects: the sampler's training loss."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.lifted.rooms import PosedRooms
from sceneprior.lifted.sampler.network import RoomSampler
from sceneprior.lifted.sampler.reading import Frame
from sceneprior.lifted.sampler.rooms import frames_of, large_first, shuffled

PARTS_OF_OBJECT = ("look", "size", "place")
"""Parts of an object's likelihood given its class."""


def negative_log_likelihood(
    sampler: RoomSampler,
    rooms: PosedRooms,
    symmetry: Int[Tensor, " rooms"],
    generator: torch.Generator,
) -> dict[str, Float[Tensor, " rooms"]]:
    """Negative log-likelihood of each room given its rectangle, in parts.

    The parts are the room's list of classes (`class`), and the look, size and place of its objects,
    each given the previous objects and the classes still to come, in a random order. The mean over
    orders is an upper bound of the negative log-likelihood of the set of objects.

    Args:
        symmetry: Symmetry in which each room is presented.
    """
    listed = shuffled(rooms, generator)
    uniform = torch.rand(rooms.is_object.shape, generator=generator).to(rooms.boxes_m)
    rooms = rooms.take(large_first(rooms.object_class, sampler.footprints_m2, uniform))
    frame = Frame(frames_of(rooms, generator), symmetry)
    rooms = replace(rooms, walls_m=None)
    tokens = sampler.tokens(rooms, frame.rectangle_m)
    counts = rooms.is_object.sum(dim=1)
    there = sampler.contents.before(rooms.object_class, rooms.is_object)
    still = there[:, -1:] - there
    zeros = tokens.new_zeros(len(counts))
    found = dict.fromkeys(PARTS_OF_OBJECT, zeros)
    # One call per step, on the rooms with that many objects, so that nothing is padded. Rooms
    # without objects are read in the first call, since the encoder rejects an empty batch.
    for step in range(max(int(counts.max()), 1)):
        row = (counts.clamp(min=1) > step).nonzero()[:, 0]
        before = _first(rooms, row, step)
        reading = sampler.read(before, still[row, step], frame.rows(row), tokens[row, :step])
        going = (counts[row] > step).nonzero()[:, 0]
        row = row[going]
        following = _first(rooms, row, step + 1).take(torch.full((len(row), 1), step).to(row))
        for name, log_prob in sampler.log_prob(reading.rows(going), following).items():
            found[name] = found[name].index_add(0, row, -log_prob)
    listing = sampler.contents.negative_log_likelihood(
        listed.object_class, listed.is_object, frame.rectangle_m[:, 2:]
    )
    return {"class": listing, **found}


def _first(rooms: PosedRooms, row: Int[Tensor, " some"], step: int) -> PosedRooms:
    """The rooms with indices `row`, cut to their first `step` objects."""
    return rooms.changed(lambda part: part[row, :step])
