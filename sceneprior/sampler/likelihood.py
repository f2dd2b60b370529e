"""How likely rooms are, in a random order of their objects: what the sampler is trained by."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.sampler.network import Frame, Reading, RoomSampler
from sceneprior.sampler.rooms import frames_of, large_first, shuffled
from sceneprior.views import RoomBoxes


def negative_log_likelihood(
    sampler: RoomSampler,
    rooms: RoomBoxes,
    symmetry: Int[Tensor, " rooms"],
    generator: torch.Generator,
) -> dict[str, Float[Tensor, " rooms"]]:
    """Of each room given its rectangle, part by part: of what it holds, and of every object given
    those before it and the classes of the rest, in an order drawn by the generator.

    The mean over orders bounds that of the set from above.

    Args:
        symmetry: In which of their symmetries the rooms are shown.
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
    # All rooms that have an object more than so many at a time: nothing is padded. Rooms without
    # any are read once, too, since no encoder takes a batch of none.
    for step in range(max(int(counts.max()), 1)):
        row = (counts.clamp(min=1) > step).nonzero()[:, 0]
        before = _first(rooms, row, step)
        readings.append(sampler.read(before, still[row, step], frame.rows(row), tokens[row, :step]))
        rows.append(row)
        steps.append(torch.full_like(row, step))
    row, number = torch.cat(rows), torch.cat(steps)
    some = (number < counts[row]).nonzero()[:, 0]
    taken = rooms.changed(lambda part: part[row])
    whole = Reading(
        taken.only(torch.arange(slots, device=row.device) < number[:, None]),
        frame.rows(row),
        torch.cat([reading.context for reading in readings]),
        torch.cat(
            [F.pad(each.objects, (0, 0, 0, slots - each.objects.shape[1])) for each in readings]
        ),
    ).rows(some)
    row, number = row[some], number[some]
    taken = rooms.changed(lambda part: part[row])
    found = sampler.log_prob(whole, taken.take(number[:, None]))
    zeros = tokens.new_zeros(len(counts))
    return {
        "class": sampler.contents.negative_log_likelihood(
            listed.object_class, listed.is_object, frame.rectangle_m[:, 2:]
        ),
        **{name: zeros.index_add(0, row, -log_prob) for name, log_prob in found.items()},
    }


def _first(rooms: RoomBoxes, row: Int[Tensor, " some"], step: int) -> RoomBoxes:
    """Of some of the rooms the first so many objects."""
    return rooms.changed(lambda part: part[row, :step])
