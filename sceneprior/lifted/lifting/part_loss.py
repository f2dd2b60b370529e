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
hang, or stand without tipping over. Parts are cut to the outline, so what lies outside it closes no
gap and supports nothing.
"""

from collections.abc import Iterable
from typing import NamedTuple, no_type_check

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int
from numba import njit

from sceneprior.core.parts import ACROSS_X, ACROSS_Z, BOX, MOST_CORNERS, SQUARE, Parts
from sceneprior.lifted.lifting import RayPool
from sceneprior.lifted.lifting.part_rays import (
    LEVELS,
    cut_rays,
    descend,
    meets,
    planes_of,
    volume_of,
)

PART_PRICE, CURVED_PRICE, PLANE_PRICE = 0.002, 0.002, 0.002
VOLUME_PRICE, GAP_PRICE, PIECE_PRICE, OVERHANG_PRICE = -0.0005, 0.06, 0.005, 0.1
FEWEST = 50
"""Added to the numbers of hits and misses, which limits the weight of a ray where there are few."""
UPRIGHT = 0.075
"""Number of vertical rays within the outline, as a share of all others."""

SMOOTHED = 0.3
"""Tolerance in cells of the simplification of outlines. Contours cut the corners of cells
diagonally, and with a larger tolerance these cuts would slant the sides of rectangles."""
FULL = 0.97
"""Share of the box's area above which an outline is replaced by the whole box."""

Part = tuple[int, int, Int[np.ndarray, "3 2"]]
"""Kind, mirroring and ends of a part, in levels (`part_rays.py`)."""
Change = dict[int, Part]
"""The parts that change, by their index; the index after the last adds a part."""


class Guess(NamedTuple):
    """Candidate parts, with the rays that meet them."""

    kinds: Int[np.ndarray, " parts"]
    mirrored: Int[np.ndarray, " parts"]
    ends: Int[np.ndarray, "parts 3 2"]
    """Lower and upper end along each axis, in levels."""
    covered: Bool[np.ndarray, "parts rays"]
    """True if the part meets the ray."""
    met_by: Int[np.ndarray, " rays"]
    """Number of parts that each ray meets."""

    def parts(self, outline: Float[np.ndarray, "corners 2"] = SQUARE) -> Parts:
        """The parts in the frame of the object's box."""
        return Parts(self.kinds, self.mirrored, self.ends / LEVELS - 0.5, outline)

    def part(self, row: int) -> Part:
        """One of the parts."""
        return int(self.kinds[row]), int(self.mirrored[row]), self.ends[row]


class RayFit:
    """The loss of parts on a set of rays, in the frame of the object's box, and on vertical rays
    through its outline. The arguments are those of `fit_parts`."""

    def __init__(
        self, rays: RayPool, margin: float, outline: Float[np.ndarray, "corners 2"], hangs: bool
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
        self.hangs, self.area = hangs, area_table(outline, LEVELS)

    def loss(self, guess: Guess) -> float:
        """The loss that the module's docstring defines."""
        prices = self.hit_price, self.miss_price
        return float(_loss(*guess[:3], guess.met_by, self.hits, *prices, self.area, self.hangs))

    def faults(self, guess: Guess) -> int:
        """Number of pieces beyond one, one more for a gap to the floor or the ceiling, and one more
        for an overhang."""
        gap, pieces, beyond = stability(guess.mirrored, guess.ends, self.area, self.hangs)
        return abs(int(pieces) - 1) + int(gap > 0) + int(beyond > 0)

    def guess(
        self,
        kinds: Int[np.ndarray, " parts"],
        mirrored: Int[np.ndarray, " parts"],
        ends: Int[np.ndarray, "parts 3 2"],
    ) -> Guess:
        """A guess of these parts; the rays that they meet are computed."""
        rays = len(self.hits)
        every = Guess(
            kinds, mirrored, ends, np.zeros((len(kinds), rays), bool), np.zeros(rays, np.int16)
        )
        return self.changed(every, {row: every.part(row) for row in range(len(kinds))})

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
    # The sides of the box are free. Across x and z, a plane and its mirror image count once.
    used = planes_of(ends, -1)
    half = LEVELS // 2 + 1
    planes = used[1, 1:LEVELS].sum() + used[0, 1:half].sum() + used[2, 1:half].sum()
    gap, pieces, overhang = stability(mirrored, ends, area, hangs)
    return (
        hit_price * missed
        + miss_price * wrongly_met
        + PART_PRICE * len(kinds)
        + CURVED_PRICE * curved
        + PLANE_PRICE * planes
        + VOLUME_PRICE * volume
        + GAP_PRICE * gap / LEVELS
        + PIECE_PRICE * (pieces - 1)
        + OVERHANG_PRICE * overhang / LEVELS
    )


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def stability(mirrored, ends, area, hangs):
    """Three measures of parts and their mirror images over an outline, whose area table is that of
    `area_table`.

    The gap in levels between the largest connected piece and the bottom of the object's box (the
    top, if the object hangs). The number of pieces, in which parts at most one level apart are
    connected. The overhang in levels, along x plus along z, from the rectangle around the lowest
    parts to the parts' centre of volume or to the middle of the box, whichever is further away:
    with the centre outside, an object tips over; with the middle outside, it stands on one side
    alone, as furniture hardly ever does. An object that hangs has no overhang.
    """
    solids = np.empty((4 * len(ends), 3, 2), np.int64)
    count = 0
    for part in range(len(ends)):
        for copy in range(4):
            if copy & ~mirrored[part]:
                continue
            solids[count] = ends[part]
            for bit, axis in ((ACROSS_X, 0), (ACROSS_Z, 2)):
                if copy & bit:
                    solids[count, axis, 0] = LEVELS - ends[part, axis, 1]
                    solids[count, axis, 1] = LEVELS - ends[part, axis, 0]
            x1, x2 = solids[count, 0]
            z1, z2 = solids[count, 2]
            count += area[x2, z2] - area[x1, z2] - area[x2, z1] + area[x1, z1] > 0
    if not count:
        return LEVELS, 0, 0.0
    solids = solids[:count]
    piece, pieces = np.arange(count), count
    for one in range(count):
        for other in range(one):
            touch = True
            for axis in range(3):
                touch &= solids[one, axis, 0] <= solids[other, axis, 1] + 1
                touch &= solids[other, axis, 0] <= solids[one, axis, 1] + 1
            if touch and piece[one] != piece[other]:
                gone, pieces = piece[one], pieces - 1
                for each in range(count):
                    if piece[each] == gone:
                        piece[each] = piece[other]
    lowest = solids[:, 1, 0].min()
    center, volume = np.zeros(3), np.zeros(count)
    low, high = np.full(3, float(LEVELS)), np.zeros(3)
    for row in range(count):
        solid = solids[row]
        sides = solid[:, 1] - solid[:, 0]
        share = float(sides[0] * sides[1] * sides[2])
        volume[piece[row]] += share
        for axis in range(3):
            center[axis] += share * (solid[axis, 0] + solid[axis, 1]) / 2
            if solid[1, 0] <= lowest + 1:
                low[axis] = min(low[axis], solid[axis, 0])
                high[axis] = max(high[axis], solid[axis, 1])
    gap, largest, overhang = LEVELS, volume.argmax(), 0.0
    for row in range(count):
        if piece[row] == largest:
            gap = min(gap, LEVELS - solids[row, 1, 1] if hangs else solids[row, 1, 0])
    if not hangs:
        for axis in (0, 2):
            apart = 0.0
            for middle in (center[axis] / volume.sum(), LEVELS / 2):
                apart = max(apart, low[axis] - middle, middle - high[axis])
            overhang += apart
    return gap, pieces, overhang


def outline_of(hull: Bool[np.ndarray, "x y z"]) -> Float[np.ndarray, "corners 2"]:
    """Outline of the largest piece of a visual hull seen from above, scaled to touch all four sides
    of the object's box; `SQUARE` if the hull nearly fills the box, or is empty. The hull's grid
    spans the box."""
    from skimage.measure import find_contours  # imported here: `explain_rays` does not need it

    seen = np.pad(hull.any(axis=1), 1).astype(np.float64)
    found = [shapely.Polygon(line) for line in find_contours(seen, 0.5) if len(line) > 3]
    if not found:
        return SQUARE
    largest = max(found, key=lambda each: float(each.area))
    tolerance = SMOOTHED
    while len((polygon := largest.simplify(tolerance)).exterior.coords) - 1 > MOST_CORNERS:
        tolerance *= 1.25
    corners = shapely.get_coordinates(shapely.geometry.polygon.orient(polygon))[:-1]
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (high - low).min() < 3:
        return SQUARE
    outline: np.ndarray = (corners - low) / (high - low) - 0.5
    return outline if shapely.Polygon(outline).area <= FULL else SQUARE


def area_table(
    outline: Float[np.ndarray, "corners 2"], levels: int
) -> Int[np.ndarray, "edges edges"]:
    """Number of cells, of a grid over the box, at lower x and z whose centres lie within an
    outline (a summed-area table)."""
    centres = (np.arange(levels) + 0.5) / levels - 0.5
    inside = shapely.contains_xy(shapely.Polygon(outline), *np.meshgrid(centres, centres))
    return np.pad(inside.T.astype(np.int64).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))


def points_within(
    outline: Float[np.ndarray, "corners 2"], count: int
) -> Float[np.ndarray, "count 2"]:
    """Random points within an outline, from a fixed seed."""
    rng = np.random.default_rng(0)
    polygon = shapely.Polygon(outline)
    found = np.empty((0, 2))
    while len(found) < count:
        offered = rng.uniform(-0.5, 0.5, (2 * count, 2))
        found = np.concatenate([found, offered[shapely.contains_xy(polygon, offered)]])
    return found[:count]
