"""How likely rooms are, in a random order of their objects: what the sampler is trained by."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.sampler.network import Reading, RoomSampler
from sceneprior.sampler.rooms import frames_of, shuffled
from sceneprior.views import RoomBoxes


def negative_log_likelihood(
    sampler: RoomSampler, rooms: RoomBoxes, generator: torch.Generator
) -> dict[str, Float[Tensor, " rooms"]]:
    """Of each room given its rectangle, part by part: of every object and the room's end, each
    given those before it, in an order drawn by the generator.

    The mean over orders bounds that of the set from above.
    """
    rooms = shuffled(rooms, generator)
    rectangle_m = frames_of(rooms, generator)
    tokens = sampler.tokens(rooms, rectangle_m)
    counts, slots = rooms.is_object.sum(dim=1), tokens.shape[1]
    readings, rows, steps = [], [], []
    # All rooms that have so many objects at a time: nothing is padded.
    for step in range(int(counts.max()) + 1):
        row = (counts >= step).nonzero()[:, 0]
        before = _first(rooms, row, step)
        readings.append(sampler.read(before, rectangle_m[row], tokens[row, :step]))
        rows.append(row)
        steps.append(torch.full_like(row, step))
    row, number = torch.cat(rows), torch.cat(steps)
    taken = rooms.changed(lambda part: part[row])
    whole = Reading(
        taken.only(torch.arange(slots, device=row.device) < number[:, None]),
        rectangle_m[row],
        torch.cat([reading.summary for reading in readings]),
        torch.cat([reading.context for reading in readings]),
        torch.cat(
            [F.pad(each.objects, (0, 0, 0, slots - each.objects.shape[1])) for each in readings]
        ),
    )
    more = (number < counts[row])[:, None]
    coming = taken.take(number.clamp(max=slots - 1)[:, None]).only(more)
    found = sampler.log_prob(whole, coming)
    zeros = tokens.new_zeros(len(counts))
    return {name: zeros.index_add(0, row, -log_prob) for name, log_prob in found.items()}


def _first(rooms: RoomBoxes, row: Int[Tensor, " some"], step: int) -> RoomBoxes:
    """Of some of the rooms the first so many objects."""
    return rooms.changed(lambda part: part[row, :step])
