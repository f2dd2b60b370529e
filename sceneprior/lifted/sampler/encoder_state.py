"""Inputs of the sampler's network: a room's frame, and the encoding of partly furnished rooms."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from sceneprior.lifted.rooms import PosedRooms

OCTAVES = 6
"""Frequencies in the encoding of a length."""
LONGEST_M = 16.0
"""Longest period of that encoding, which has a sine and a cosine for each of `OCTAVES` periods;
each is half the previous one."""
LENGTHS = 1 + 2 * OCTAVES
"""Number of values that encode a length."""


class Frame(NamedTuple):
    """Properties of rooms that are known before they have any furniture."""

    rectangle_m: Float[Tensor, "rooms 4"]
    """Rectangle that the furniture may fill: centre x, z and extents x, z."""
    symmetry: Int[Tensor, " rooms"]
    """Index of the symmetry, out of `SYMMETRIES`, in which each room is presented; 0 is
    untransformed."""

    @classmethod
    def plain(cls, rectangle_m: Float[Tensor, "rooms 4"]) -> "Frame":
        """The frame of untransformed rooms."""
        return cls(rectangle_m, rectangle_m.new_zeros(len(rectangle_m), dtype=torch.int64))

    def rows(self, chosen: Tensor) -> "Frame":
        """These frames, reduced to the chosen rooms."""
        return Frame(self.rectangle_m[chosen], self.symmetry[chosen])


class EncoderState(NamedTuple):
    """Encoder outputs for partly furnished rooms."""

    before: PosedRooms
    frame: Frame
    coming: Float[Tensor, "rooms classes"]
    """Number of objects of each class that are still to be placed."""
    context: Float[Tensor, "rooms width"]
    """Output of the query: the context for the next object."""

    def rows(self, rows: Int[Tensor, " some"]) -> "EncoderState":
        """These outputs, reduced to the rooms with these indices."""
        before = self.before.changed(lambda part: part[rows])
        return EncoderState(before, self.frame.rows(rows), self.coming[rows], self.context[rows])


def fourier_features(lengths_m: Float[Tensor, "*batch numbers"]) -> Float[Tensor, "*batch shown"]:
    """Encode lengths: the lengths themselves (in units of 4 m), then their Fourier features, a sine
    and a cosine for each of `OCTAVES` periods."""
    octaves = torch.arange(OCTAVES, device=lengths_m.device, dtype=lengths_m.dtype)
    phase = (lengths_m.unsqueeze(-1) * (2 * math.pi / LONGEST_M * 2**octaves)).flatten(-2)
    return torch.cat([lengths_m / 4, phase.sin(), phase.cos()], dim=-1)
