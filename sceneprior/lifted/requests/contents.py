"""Contents of a requested room, drawn from the sampler's distribution given counts of classes."""

import numpy as np
import torch
from jaxtyping import Float

from sceneprior.core.mixtures import draw_index
from sceneprior.lifted.requests.wishes import Wishes
from sceneprior.lifted.sampler.contents import END
from sceneprior.lifted.sampler.network import RoomSampler


def required_rows(wishes: Wishes, classes: tuple[str, ...], given: list[int]) -> list[int]:
    """The class index of each object that the wishes require beyond those in `given`, the class
    indices of the objects that are already there."""
    required = []
    for label in wishes.labels:
        index = classes.index(label)
        required += [index] * max(0, wishes.bounds(label)[0] - given.count(index))
    return required


def draw_contents(
    sampler: RoomSampler,
    wishes: Wishes,
    classes: tuple[str, ...],
    given: list[int],
    extents_m: Float[np.ndarray, "2"],
    uniform: Float[np.ndarray, " slots"],
) -> list[int]:
    """Classes to add to the given objects: first those that the wishes require, then others.

    The network was trained to continue any subset of a room's classes, so it draws the others given
    the required ones. A class that has reached its largest allowed number is excluded.
    """
    added = required_rows(wishes, classes, given)
    counts = torch.zeros(1, len(sampler.contents.known))
    for index in (*given, *added):
        counts[0, index] += 1
    most = torch.full_like(counts[0], torch.inf)
    for label in wishes.labels:
        largest = wishes.bounds(label)[1]
        if largest is not None:
            most[classes.index(label)] = largest
    extents = torch.from_numpy(extents_m).to(counts)[None]
    for chance in torch.from_numpy(uniform).float():
        if int(counts.sum()) >= sampler.max_objects:
            break
        full = counts[0] >= most
        full[END] = False
        logits = sampler.contents(counts, extents).masked_fill(full, -torch.inf)
        index = int(draw_index(logits, chance[None]))
        if index == END:
            break
        added.append(index)
        counts[0, index] += 1
    return added
