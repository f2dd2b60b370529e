"""Shapes that are no larger than masks ask for: what no view sees past may still be air.

A visual hull is the largest shape that masks allow: domes stand on beds, and armchairs are full.
"""

from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy import ndimage

from sceneprior.geometry.turns import turn_grids
from sceneprior.lifting.lookalikes import Lookalike, lookalikes, moved_vectors
from sceneprior.lifting.rays import RayPool
from sceneprior.silhouettes.cpu.threads import in_threads

STEPS, RAYS, SAMPLES = 150, 128, 24
"""Of the fit; rays and places along each of them in a step."""
RATE = 0.2
OWN_SHARE = 0.2
"""Of the rays; the others are those of lookalikes."""
SHARPNESS = 4.0
"""Of the soft maximum along a ray."""
VARIATION, VOLUME = 0.3, 0.1
"""What the total variation of the occupancies and their mean weigh beside the rays' entropy."""
START = 2.0
"""Logits at first: plus in the hull, minus outside."""


class _Pool(NamedTuple):
    starts: Float[np.ndarray, "rays 3"]
    spans: Float[np.ndarray, "rays 3"]
    hits: Bool[np.ndarray, " rays"]


def thin_shapes(
    hulls: Bool[np.ndarray, "objects x y z"],
    rays: RayPool,
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
    seed: int = 0,
) -> Bool[np.ndarray, "objects x y z"]:
    """Hulls without what neither an object's rays nor its lookalikes' need.

    For each object, logits z of the cells are fitted to its own rays and to those of its lookalikes
    by Adam, so that they are few and smooth:

        mean entropy of rays + 0.3 total variation of s(z) + 0.1 mean of s(z)

    with s the sigmoid and a ray's logit log(sum_i exp(4 z_i)) / 4 - log(samples) / 8. Random rays
    fray the outlines of such fits. Hulls have sharp ones, so a hull keeps all of its cells in and
    beside those with z > 0.

    Args:
        hulls: Of all objects of a data set; see `lift_shapes`.
        rays: In the same frames.
        sizes_m: Of the objects' boxes.
        object_class: Only objects of one class can look alike.
        seed: Of the rays that are drawn.
    """
    alike = lookalikes(hulls, sizes_m, object_class)
    thin = np.zeros_like(hulls)
    filled = np.flatnonzero(hulls.any(axis=(1, 2, 3)))
    in_threads(_thin_some, len(filled), filled, hulls, rays, alike, seed, thin)
    return thin


def _thin_some(
    first: int,
    last: int,
    items: Int[np.ndarray, " filled"],
    hulls: np.ndarray,
    rays: RayPool,
    alike: list[list[Lookalike]],
    seed: int,
    thin: np.ndarray,
) -> None:
    for item in items[first:last].tolist():
        # Of each object's own, however many threads there are.
        rng = np.random.default_rng([seed, item])
        pool = _pool_of(item, rays, alike[item], rng)
        others = [
            turn_grids(hulls[other.item][None], other.quarters, other.mirrored)[0]
            for other in alike[item]
        ]
        logits = START * (2 * np.mean([hulls[item], *others], axis=0) - 1)
        picked = rng.integers(len(pool.hits), size=(STEPS, RAYS))
        offsets = rng.random((STEPS, RAYS))
        _fit(logits, *pool, picked, offsets)
        thin[item] = hulls[item] & ndimage.binary_dilation(logits > 0, np.ones((3, 3, 3)))


def _pool_of(item: int, rays: RayPool, alike: list[Lookalike], rng: np.random.Generator) -> _Pool:
    own = _Pool(rays.starts[item], rays.spans[item], rays.hits[item])
    if not alike:
        return own
    count = int(len(own.hits) * (1 - OWN_SHARE) / OWN_SHARE)
    which = np.sort(rng.integers(len(alike), size=count))
    row = rng.integers(len(own.hits), size=count)
    parts = [own]
    for place, other in enumerate(alike):
        rows = row[which == place]
        starts, spans = (
            moved_vectors(vectors[other.item][rows], other.quarters, other.mirrored)
            for vectors in (rays.starts, rays.spans)
        )
        parts.append(_Pool(starts, spans, rays.hits[other.item][rows]))
    return _Pool(*(np.concatenate(part) for part in zip(*parts, strict=True)))


@njit(cache=True, nogil=True)
@no_type_check
def _fit(logits, starts, spans, hits, picked, offsets):
    """Adam on the logits, in place; rates fall by a cosine."""
    mean, square = np.zeros_like(logits), np.zeros_like(logits)
    slope = np.empty_like(logits)
    for step in range(len(picked)):
        slope[:] = 0
        some = picked[step]
        ray_slope(logits, starts[some], spans[some], hits[some], offsets[step], SAMPLES, slope)
        regular_slope(logits, VARIATION, VOLUME, slope)
        rate = RATE * (0.5 + 0.5 * np.cos(np.pi * step / len(picked))) + 0.01
        first, second = 1 - 0.9 ** (step + 1), 1 - 0.95 ** (step + 1)
        mean[:] = 0.9 * mean + 0.1 * slope
        square[:] = 0.95 * square + 0.05 * slope * slope
        logits -= rate * (mean / first) / (np.sqrt(square / second) + 1e-8)


@njit(cache=True, nogil=True)
@no_type_check
def ray_slope(logits, starts, spans, hits, offsets, samples, slope):
    """Add the gradient of the rays' mean binary cross entropy; a ray without a span tells nothing.

    Logits are trilinear between the cells' centres, and constant from the outermost ones outwards.
    """
    cells = logits.shape[0]
    corner = np.empty((samples, 3), np.int64)
    part = np.empty((samples, 3))
    along = np.empty(samples)
    counted = 0
    for ray in range(len(hits)):
        counted += np.abs(spans[ray]).max() > 0
    for ray in range(len(hits)):
        if np.abs(spans[ray]).max() == 0:
            continue
        largest = -np.inf
        for i in range(samples):
            share = (i + offsets[ray]) / samples
            for axis in range(3):
                place = (starts[ray, axis] + share * spans[ray, axis] + 1) / 2 * cells - 0.5
                place = min(max(place, 0.0), cells - 1.0)
                corner[i, axis] = min(int(place), cells - 2)
                part[i, axis] = place - corner[i, axis]
            value = 0.0
            for a in range(2):
                for b in range(2):
                    for c in range(2):
                        weight = (
                            (part[i, 0] if a else 1 - part[i, 0])
                            * (part[i, 1] if b else 1 - part[i, 1])
                            * (part[i, 2] if c else 1 - part[i, 2])
                        )
                        value += (
                            weight * logits[corner[i, 0] + a, corner[i, 1] + b, corner[i, 2] + c]
                        )
            along[i] = value
            largest = max(largest, value)
        total = 0.0
        for i in range(samples):
            along[i] = np.exp(SHARPNESS * (along[i] - largest))
            total += along[i]
        logit = largest + np.log(total) / SHARPNESS - np.log(samples) / (2 * SHARPNESS)
        pull = (1 / (1 + np.exp(-logit)) - hits[ray]) / counted
        for i in range(samples):
            for a in range(2):
                for b in range(2):
                    for c in range(2):
                        weight = (
                            (part[i, 0] if a else 1 - part[i, 0])
                            * (part[i, 1] if b else 1 - part[i, 1])
                            * (part[i, 2] if c else 1 - part[i, 2])
                        )
                        slope[corner[i, 0] + a, corner[i, 1] + b, corner[i, 2] + c] += (
                            pull * weight * along[i] / total
                        )


@njit(cache=True, nogil=True)
@no_type_check
def regular_slope(logits, variation, volume, slope):
    """Add the gradient of the weighted total variation and mean of the occupancies: the mean
    absolute difference of neighbours along x, plus along y, plus along z."""
    cells = logits.shape[0]
    occupancy = 1 / (1 + np.exp(-logits))
    per_pair = variation / (cells * cells * (cells - 1))
    per_cell = volume / cells**3
    for x in range(cells):
        for y in range(cells):
            for z in range(cells):
                here = occupancy[x, y, z]
                sides = 0.0
                if x > 0:
                    sides += np.sign(here - occupancy[x - 1, y, z])
                if x < cells - 1:
                    sides += np.sign(here - occupancy[x + 1, y, z])
                if y > 0:
                    sides += np.sign(here - occupancy[x, y - 1, z])
                if y < cells - 1:
                    sides += np.sign(here - occupancy[x, y + 1, z])
                if z > 0:
                    sides += np.sign(here - occupancy[x, y, z - 1])
                if z < cells - 1:
                    sides += np.sign(here - occupancy[x, y, z + 1])
                slope[x, y, z] += (per_pair * sides + per_cell) * here * (1 - here)
