"""Looks along a path between rooms: where on the path each look is shown, and blends of two looks
in which each solid of one becomes a solid of the other."""

from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.core.parts import BOX, SQUARE, Parts

HOLD = 0.125
"""Minimum share of the path that a look between two others must hold to be shown. A smaller value
follows the decoder more closely, but objects change faster."""


class Appearance(NamedTuple):
    """Looks shown during one appearance of a prediction on a path, and the place of each."""

    places: Float[np.ndarray, " shown"]
    looks: Int[np.ndarray, " shown"]

    def apart(self, place: float) -> float:
        """Distance of a place on the path from this appearance."""
        return float(np.abs(place - np.clip(place, *self.places[[0, -1]])))

    def at(self, place: float) -> tuple[int, int, float]:
        """The two looks between which the shape lies, and the weight of the second, in [0, 1)."""
        after = int(np.searchsorted(self.places, place, side="right"))
        look, next_look = self.looks[max(after - 1, 0)], self.looks[min(after, len(self.looks) - 1)]
        if after in (0, len(self.looks)) or look == next_look:
            return int(look), int(look), 0.0
        start, end = self.places[after - 1 : after + 1]
        return int(look), int(next_look), float((place - start) / (end - start))


def appearances_of(
    looks: Int[np.ndarray, " steps"], kept: Bool[np.ndarray, " steps"]
) -> list[Appearance]:
    """The looks that one prediction shows on a path, for each of its appearances.

    `looks` has the decoded look at equal steps from 0 to 1, and `kept` is true where the prediction
    is an object. The first and last look of an appearance are shown at its ends. A look between
    them that holds for at least `HOLD` is shown in the middle of the steps where it holds.
    """
    places = np.linspace(0, 1, len(looks))
    changes = np.flatnonzero(np.diff(np.where(kept, looks, -1))) + 1
    found = []
    for steps in np.split(np.arange(len(looks)), np.flatnonzero(np.diff(kept)) + 1):
        if not kept[steps[0]]:
            continue
        within = changes[(changes > steps[0]) & (changes <= steps[-1])] - steps[0]
        ends = places[steps[[0, -1]]]
        between = [
            (places[run[[0, -1]]].mean(), looks[run[0]])
            for run in np.split(steps, within)[1:-1]
            if len(run) >= HOLD * (len(looks) - 1)
        ]
        shown = [(ends[0], looks[steps[0]]), *between, (ends[1], looks[steps[-1]])]
        found.append(Appearance(*map(np.array, zip(*shown, strict=True))))
    return found


SLIVER = 1e-3
"""Grid, as a share of the box, to which the ends of blended solids are rounded. Ends that differ by
less than the overlap of parts (`parts.OVERLAP`) would give the mesh faces of zero area."""
OTHER_KIND = 1e3
"""Cost of pairing solids of different kinds; larger than all other costs together."""
DECIMALS = 6
"""Decimals to which costs and places are rounded, so that ties are resolved alike everywhere."""


def blend_parts(a: Parts, b: Parts, share: float) -> Parts:
    """Blend two matched objects (`matched_parts`): `a` at share 0, `b` at share 1.

    The bounding box of all solids changes linearly with `share`.
    """
    if share in (0, 1):
        return b if share else a

    def between(here: np.ndarray, there: np.ndarray) -> np.ndarray:
        return np.asarray((1 - share) * here + share * there)

    ends = between(a.ends, b.ends)
    (low, high), (new_low, new_high) = _bounds(ends), between(_bounds(a.ends), _bounds(b.ends))
    scale = (new_high - new_low) / np.maximum(high - low, SLIVER)
    placed = (ends - low[:, None]) * scale[:, None] + new_low[:, None]
    steps = (placed / SLIVER).round() * SLIVER
    return Parts(a.kind, a.mirrored, steps, between(a.outline, b.outline))


def _bounds(ends: Float[np.ndarray, "solids 3 2"]) -> Float[np.ndarray, "2 3"]:
    return np.stack([ends[..., 0].min(axis=0), ends[..., 1].max(axis=0)])


def matched_parts(a: Parts, b: Parts) -> tuple[Parts, Parts]:
    """Give two objects equally many solids and outline corners, which correspond by index.

    Mirror images become separate solids. Solids of the same kind are paired one to one, with the
    least sum of squared differences between their ends. An unpaired solid gets a copy of itself as
    its partner, hidden in the nearest box of the other object, or squeezed into its own centre if
    the other object has no box. The order of the parts does not matter.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial.distance import cdist

    one, other = _solids(a), _solids(b)
    if (len(other), other.tolist()) < (len(one), one.tolist()):
        second, first = matched_parts(b, a)  # ties are then decided alike in both directions
        return first, second
    cost = cdist(one[:, 1:], other[:, 1:], "sqeuclidean").round(DECIMALS)
    rows, columns = linear_sum_assignment(cost + OTHER_KIND * (one[:, :1] != other[:, 0]))
    alike = one[rows, 0] == other[columns, 0]
    rows, columns = rows[alike], columns[alike]
    gone, new = np.delete(one, rows, axis=0), np.delete(other, columns, axis=0)
    here = np.concatenate([one[rows], gone, _hidden(new, one)])
    there = np.concatenate([other[columns], _hidden(gone, other), new])
    outlines = matched_outlines(a.outline, b.outline)
    kind = here[:, 0].astype(np.int64)
    first, second = (
        Parts(kind, np.zeros_like(kind), solids[:, 1:].reshape(-1, 3, 2), outline)
        for solids, outline in zip((here, there), outlines, strict=True)
    )
    return first, second


def _solids(parts: Parts) -> Float[np.ndarray, "solids 7"]:
    """Kind and ends of each solid, sorted. A part that equals its own mirror image is listed
    once."""
    rows = np.array([[kind, *ends.ravel()] for kind, ends in parts.solids()])
    _, first = np.unique(rows.round(DECIMALS), axis=0, return_index=True)
    return rows[first]


def _hidden(
    solids: Float[np.ndarray, "gone 7"], among: Float[np.ndarray, "solids 7"]
) -> Float[np.ndarray, "gone 7"]:
    """Solids squeezed into the nearest box of another object, or into their centres."""
    hosts = among[among[:, 0] == BOX, 1:].reshape(-1, 3, 2)
    hidden = solids.copy()
    for row, solid in enumerate(solids):
        ends = solid[1:].reshape(3, 2)
        squeezed = ends.mean(axis=1, keepdims=True).repeat(2, axis=1)
        if len(hosts):
            inside = ends.clip(hosts[..., :1], hosts[..., 1:])
            moved = ((inside - ends) ** 2).sum(axis=(1, 2)).round(DECIMALS)
            squeezed = inside[moved.argmin()]
        hidden[row, 1:] = squeezed.ravel()
    return hidden


def matched_outlines(
    a: Float[np.ndarray, "a 2"], b: Float[np.ndarray, "b 2"]
) -> tuple[Float[np.ndarray, "corners 2"], Float[np.ndarray, "corners 2"]]:
    """Give two outlines equally many corners, which correspond by index.

    Each outline is divided at the four points nearest to the corners of `SQUARE`. These points
    correspond, and so do points at the same share of the length between two of them. The results
    have a corner wherever either outline has one.
    """
    if np.array_equal(a, b):
        return a, b
    both = _Around(a), _Around(b)
    places = np.unique(np.concatenate([np.arange(4.0), *(each.corners for each in both)]))
    return both[0].points(places), both[1].points(places)


class _Around:
    """Parametrises an outline by places from 0 to 4: whole numbers are the points nearest to the
    corners of `SQUARE`, in its order."""

    def __init__(self, outline: Float[np.ndarray, "corners 2"]):
        self.closed = np.concatenate([outline, outline[:1]])
        sides = np.linalg.norm(np.diff(self.closed, axis=0), axis=1)
        self.lengths = np.concatenate([[0], sides.cumsum()])
        ring, whole = shapely.LinearRing(outline), self.lengths[-1]
        nearest = np.array([ring.project(shapely.Point(corner)) for corner in SQUARE])
        self.start = nearest[0]
        # Nearest points are in the order of the corners; rounding may swap equal ones.
        ahead = np.maximum.accumulate(((nearest - self.start) / whole).round(DECIMALS) % 1)
        self.knots = np.append(ahead, 1) * whole
        own = np.interp((self.lengths[:-1] - self.start) % whole, self.knots, np.arange(5.0))
        self.corners = own.round(DECIMALS) % 4

    def points(self, places: Float[np.ndarray, " places"]) -> Float[np.ndarray, "places 2"]:
        """The points at these places."""
        ahead = np.interp(places, np.arange(5.0), self.knots)
        at = (ahead + self.start) % self.lengths[-1]
        return np.stack([np.interp(at, self.lengths, axis) for axis in self.closed.T], axis=1)
