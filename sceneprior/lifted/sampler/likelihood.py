"""Likelihood of rooms, in a random order of their objects: the sampler's training loss."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.views import RoomBoxes
from sceneprior.lifted.sampler.network import Frame, Reading, RoomSampler
from sceneprior.lifted.sampler.rooms import frames_of, large_first, shuffled


def negative_log_likelihood(
    sampler: RoomSampler,
    rooms: RoomBoxes,
    symmetry: Int[Tensor, " rooms"],
    generator: torch.Generator,
) -> dict[str, Float[Tensor, " rooms"]]:
    """Negative log-likelihood of each room given its rectangle, in parts: that of its contents, and
    that of every object given the previous ones and the classes still to come, in a random order.

    Its mean over orders is an upper bound of the negative log-likelihood of the set.

    Args:
        symmetry: Symmetry in which each room is presented.
    """
    listed = shuffled(rooms, generator)
    uniform = torch.rand(rooms.is_object.shape, generator=generator).to(rooms.boxes_m)
    rooms = rooms.take(large_first(rooms.object_class, sampler.footprints_m2, uniform))
    frame = Frame(frames_of(rooms, generator), symmetry)
    tokens = sampler.tokens(rooms, frame.rectangle_m)
    counts, slots = rooms.is_object.sum(dim=1), tokens.shape[1]
    there = sampler.contents.before(rooms.object_class, rooms.is_object)
    still = there[:, -1:] - there
    readings, rows, steps = [], [], []
    # One encoder call per step, on the rooms that have that many objects: nothing is padded. Rooms
    # without objects take part in the first call, since the encoder rejects an empty batch.
    for step in range(max(int(counts.max()), 1)):
        row = (counts.clamp(min=1) > step).nonzero()[:, 0]
        before = _first(rooms, row, step)
        readings.append(sampler.read(before, still[row, step], frame.rows(row), tokens[row, :step]))
        rows.append(row)
        steps.append(torch.full_like(row, step))
    row, number = torch.cat(rows), torch.cat(steps)
    some = (number < counts[row]).nonzero()[:, 0]
    row, number = row[some], number[some]
    taken = rooms.changed(lambda part: part[row])
    objects = [F.pad(each.objects, (0, 0, 0, slots - each.objects.shape[1])) for each in readings]
    whole = Reading(
        taken.only(torch.arange(slots, device=row.device) < number[:, None]),
        frame.rows(row),
        torch.cat([reading.context for reading in readings])[some],
        torch.cat(objects)[some],
    )
    found = sampler.log_prob(whole, taken.take(number[:, None]))
    zeros = tokens.new_zeros(len(counts))
    return {
        "class": sampler.contents.negative_log_likelihood(
            listed.object_class, listed.is_object, frame.rectangle_m[:, 2:]
        ),
        **{name: zeros.index_add(0, row, -log_prob) for name, log_prob in found.items()},
    }


def _first(rooms: RoomBoxes, row: Int[Tensor, " some"], step: int) -> RoomBoxes:
    """The first `step` objects of the rooms in `row`."""
    return rooms.changed(lambda part: part[row, :step])
