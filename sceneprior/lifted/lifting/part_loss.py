"""The loss of parts on rays. It counts rays, and has no gradient:

    half the share of hits that meet no part + half the share of misses that meet one
      + 0.002 (number of parts) + 0.002 (number of planes in which faces lie)
      + 0.002 (number of curved parts) - 0.0005 (volume of the parts, 1 for the box)
      + 0.06 (gap between the largest connected piece and the floor, or the ceiling for lamps;
              1 for the box's height)
      + 0.005 (connected pieces - 1)
      + 0.1 (overhang of the centre of volume, or of the middle of the box, beyond the feet, unless
             the object hangs; 1 for the box's width)

A ray is a hit if its pixel belongs to the object, else a miss; it is explained if it meets a part
exactly when it is a hit. Rays are cut to the object's outline, as the parts are. Vertical rays
within the outline are added as hits: cameras rarely look down, so otherwise no ray would make a
table top reach the outline.

Without the price of parts, they would model the unobserved volume that a visual hull adds: a
headboard and a mattress cost less than a dome. A part and its mirror images count once, and so do a
plane and its mirror image; the sides of the box are free, so that edges line up. The other terms
decide where rays give no evidence: unobserved volume is filled, objects are connected, and they
hang, or stand without tipping over.
"""

from collections.abc import Iterable
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit

from sceneprior.core.parts import BOX, SQUARE, Parts
from sceneprior.lifted.lifting import RayPool
from sceneprior.lifted.lifting.part_rays import descend, meets
from sceneprior.lifted.lifting.part_regularizers import (
    LEVELS,
    area_table,
    count_planes,
    cut_rays,
    gap_and_pieces,
    overhang,
    points_within,
    volume_of,
)

PART_PRICE, CURVED_PRICE, PLANE_PRICE = 0.002, 0.002, 0.002
VOLUME_PRICE, GAP_PRICE, PIECE_PRICE, OVERHANG_PRICE = -0.0005, 0.06, 0.005, 0.1
FEWEST = 50
"""Added to the numbers of hits and misses, which limits the weight of a ray where there are few."""
UPRIGHT = 0.075
"""Number of vertical rays within the outline, as a share of all others."""

Change = dict[int, tuple[int, int, Int[np.ndarray, "3 2"]]]
"""Kind, mirroring and ends of the parts that change, by their index; the index after the last adds
a part."""


class Guess(NamedTuple):
    """Candidate parts, with the rays that meet them."""

    kinds: Int[np.ndarray, " parts"]
    mirrored: Int[np.ndarray, " parts"]
    ends: Int[np.ndarray, "parts 3 2"]
    """Lower and upper end along each axis, in levels (`part_regularizers.py`)."""
    covered: Bool[np.ndarray, "parts rays"]
    """True if the part meets the ray."""
    met_by: Int[np.ndarray, " rays"]
    """Number of parts that each ray meets."""

    def parts(self, outline: Float[np.ndarray, "corners 2"] = SQUARE) -> Parts:
        """The parts in the frame of the object's box."""
        return Parts(self.kinds, self.mirrored, self.ends / LEVELS - 0.5, outline)


class RayFit:
    """The loss of parts on a set of rays, in the frame of the object's box, and on vertical rays
    through its outline. The arguments are those of `fit_parts`."""

    def __init__(
        self,
        rays: RayPool,
        margin: float,
        outline: Float[np.ndarray, "corners 2"] = SQUARE,
        hangs: bool = False,
    ):
        scale = margin / 2 * LEVELS  # the frame of rays spans [-1, 1], `margin` boxes
        starts = rays.starts.astype(np.float64) * scale + LEVELS / 2
        spans = rays.spans.astype(np.float64) * scale
        cut_rays(starts, spans, (outline + 0.5) * LEVELS)
        useful = np.abs(spans).sum(axis=1) > 0
        hits = rays.hits[useful]
        self.hit_price = 0.5 / (hits.sum() + FEWEST)
        self.miss_price = 0.5 / ((~hits).sum() + FEWEST)
        upright = points_within(outline, round(UPRIGHT * len(hits)))
        above = np.insert((upright + 0.5) * LEVELS, 1, LEVELS, axis=1)
        down = np.broadcast_to([0.0, -LEVELS, 0.0], above.shape)
        self.starts = np.concatenate([starts[useful], above])
        spans = np.concatenate([spans[useful], down])
        self.spans = np.where(np.abs(spans) < 1e-6, 1e-6, spans)  # used as divisors
        self.inverse = 1 / self.spans
        self.hits = np.concatenate([hits, np.ones(len(above), bool)])
        self.outline, self.hangs = outline, hangs
        self.area = area_table(outline, LEVELS)

    def loss(self, guess: Guess) -> float:
        """The loss that the module's docstring defines."""
        return float(
            _loss(
                *guess[:3], guess.met_by, self.hits, self.hit_price, self.miss_price, self.area,
                self.hangs,
            )
        )  # fmt: skip

    def gap_and_pieces(self, guess: Guess) -> tuple[int, int]:
        """Gap in levels to the floor or the ceiling, and number of connected pieces."""
        gap, pieces = gap_and_pieces(guess.mirrored, guess.ends, self.area, self.hangs)
        return int(gap), int(pieces)

    def overhang(self, guess: Guess) -> float:
        """Overhang in levels beyond the lowest parts; 0 for an object that hangs."""
        return 0.0 if self.hangs else float(overhang(guess.mirrored, guess.ends, self.area))

    def guess(
        self,
        kinds: Int[np.ndarray, " parts"],
        mirrored: Int[np.ndarray, " parts"],
        ends: Int[np.ndarray, "parts 3 2"],
    ) -> Guess:
        """A guess of these parts; the rays that they meet are computed."""
        none = np.zeros((0, len(self.hits)), bool)
        empty = Guess(kinds[:0], mirrored[:0], ends[:0], none, np.zeros(len(self.hits), np.int16))
        rows = zip(kinds.tolist(), mirrored.tolist(), ends, strict=True)
        return self.changed(empty, dict(enumerate(rows)))

    def changed(self, guess: Guess, change: Change) -> Guess:
        """A copy with some parts replaced or added."""
        more = max(0, max(change) + 1 - len(guess.kinds))
        kinds, mirrored, ends, covered = (
            np.concatenate([part, np.zeros((more, *part.shape[1:]), part.dtype)])
            for part in guess[:4]
        )
        count = guess.met_by.copy()
        for row, (kind, across, own) in change.items():
            kinds[row], mirrored[row], ends[row] = kind, across, own
            count -= covered[row]
            meets(self.starts, self.spans, kind, across, ends[row], covered[row])
            count += covered[row]
        return Guess(kinds, mirrored, ends, covered, count)

    def without(self, guess: Guess, row: int) -> Guess:
        """A copy without one part."""
        others = np.arange(len(guess.kinds)) != row
        kinds, mirrored, ends, covered = (part[others] for part in guess[:4])
        return Guess(kinds, mirrored, ends, covered, guess.met_by - guess.covered[row])

    def refined(self, guess: Guess, rows: Iterable[int], sweeps: int) -> Guess:
        """The guess after coordinate descent of the faces of some parts (`descend`), or the guess
        itself if its loss is lower: the descent ignores gaps and pieces."""
        moved = Guess(*(part.copy() for part in guess))
        descend(
            self.starts, self.spans, self.inverse, self.hits, moved.kinds, moved.mirrored,
            moved.ends, moved.covered, moved.met_by, np.array(list(rows)), sweeps,
            self.hit_price, self.miss_price, VOLUME_PRICE, PLANE_PRICE,
        )  # fmt: skip
        return min(guess, moved, key=self.loss)


# no_type_check: the tests' type hook wraps every function, and Numba cannot compile a wrapper.
@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _loss(kinds, mirrored, ends, met_by, hits, hit_price, miss_price, area, hangs):
    """The loss of parts, of which each ray meets `met_by`; compiled as one, since it is computed
    thousands of times for each prototype."""
    missed, wrongly_met = 0, 0
    for ray in range(len(hits)):
        missed += hits[ray] and met_by[ray] == 0
        wrongly_met += not hits[ray] and met_by[ray] > 0
    volume, curved = 0.0, 0
    for part in range(len(kinds)):
        volume += volume_of(kinds[part], mirrored[part], ends[part])
        curved += kinds[part] != BOX
    gap, pieces = gap_and_pieces(mirrored, ends, area, hangs)
    beyond = 0.0 if hangs else overhang(mirrored, ends, area)
    return (
        hit_price * missed
        + miss_price * wrongly_met
        + PART_PRICE * len(kinds)
        + CURVED_PRICE * curved
        + PLANE_PRICE * count_planes(ends)
        + VOLUME_PRICE * volume
        + GAP_PRICE * gap / LEVELS
        + PIECE_PRICE * (pieces - 1)
        + OVERHANG_PRICE * beyond / LEVELS
    )
