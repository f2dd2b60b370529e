"""Thinning of visual hulls: remove cells that no mask requires.

A visual hull is the largest shape that the masks allow, so unobserved space stays filled: hulls of
beds have domes, and armchairs are solid blocks.
"""

from typing import no_type_check

import numpy as np
from jaxtyping import Bool, Float, Int
from numba import njit
from scipy import ndimage

from sceneprior.core.geometry.turns import turn_grids
from sceneprior.lifted.lifting.lookalikes import Lookalike, lookalikes, moved_vectors
from sceneprior.lifted.lifting.rays import RayPool
from sceneprior.render.silhouettes.cpu.threads import in_threads

STEPS, RAYS, SAMPLES = 150, 128, 24
"""Steps of the fit; rays per step, and samples along each ray."""
RATE = 0.2
"""Learning rate of the fit, which falls along a cosine."""
OWN_SHARE = 0.2
"""Share of rays that are the object's own; the others come from its lookalikes."""
SHARPNESS = 4.0
"""Sharpness of the soft maximum along a ray."""
VARIATION, VOLUME = 0.3, 0.1
"""Weights of the total variation of the occupancies (`VARIATION`) and of their mean (`VOLUME`),
beside the rays' cross entropy."""
START = 2.0
"""Magnitude of the initial logits: positive in the hull, negative outside."""


def thin_shapes(
    hulls: Bool[np.ndarray, "objects x y z"],
    rays: RayPool,
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
    seed: int = 0,
) -> Bool[np.ndarray, "objects x y z"]:
    """Hulls without the cells that neither an object's rays nor its lookalikes' require.

    For each object, logits z of the cells are fitted by Adam to its own rays and to those of its
    lookalikes, with penalties that keep occupied cells few and smooth:

        mean cross entropy of rays + 0.3 total variation of s(z) + 0.1 mean of s(z)

    with s the sigmoid; a ray's logit is log(sum_i exp(4 z_i)) / 4 - log(samples) / 8. Random rays
    fray the outlines of the fitted shapes, while those of hulls are sharp. Therefore a hull keeps
    all of its cells with z > 0 and the cells beside these.

    `hulls` are those of all objects of a data set (`lift_shapes`), `rays` lie in the same frames,
    and `seed` chooses among them. Only objects of the same class can be lookalikes.
    """
    alike = lookalikes(hulls, sizes_m, object_class)
    thin = np.zeros_like(hulls)
    filled = np.flatnonzero(hulls.any(axis=(1, 2, 3)))

    def thin_some(first: int, last: int) -> None:
        for item in filled[first:last].tolist():
            # A generator per object makes the result independent of the number of threads.
            rng = np.random.default_rng([seed, item])
            pool = _pool_of(item, rays, alike[item], rng)
            others = [
                turn_grids(hulls[other.item][None], other.quarters, other.mirrored)[0]
                for other in alike[item]
            ]
            share = np.mean(np.stack([hulls[item], *others]), axis=0, dtype=np.float32)
            logits = np.asarray(START * (2 * share - 1), np.float32)
            picked = rng.integers(len(pool.hits), size=(STEPS, RAYS))
            _fit(logits, pool, picked, rng.random((STEPS, RAYS)))
            thin[item] = hulls[item] & ndimage.binary_dilation(logits > 0, np.ones((3, 3, 3)))

    in_threads(thin_some, len(filled))
    return thin


def _pool_of(item: int, rays: RayPool, alike: list[Lookalike], rng: np.random.Generator) -> RayPool:
    """The rays on which an object is fitted: its own and its lookalikes'."""
    own = RayPool(rays.starts[item], rays.spans[item], rays.hits[item])
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
        parts.append(RayPool(starts, spans, rays.hits[other.item][rows]))
    return RayPool(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _fit(
    logits: Float[np.ndarray, "x y z"],
    pool: RayPool,
    picked: Int[np.ndarray, "steps rays"],
    offsets: Float[np.ndarray, "steps rays"],
) -> None:
    """Fit the logits in place by Adam; its rate falls along a cosine."""
    mean, square, slope, occupancy = (np.zeros_like(logits) for _ in range(4))
    number = logits.dtype.type
    for step, (some, offset) in enumerate(zip(picked, offsets, strict=True)):
        # NumPy's exp is vectorised, Numba's is not.
        np.exp(np.negative(logits, out=occupancy), out=occupancy)
        occupancy += 1
        np.reciprocal(occupancy, out=occupancy)
        regular_slope(occupancy, number(VARIATION), number(VOLUME), slope)
        ray_slope(logits, *(part[some] for part in pool), offset, SAMPLES, slope)
        rate = RATE * (0.5 + 0.5 * np.cos(np.pi * step / len(picked))) + 0.01
        first, second = 1 - 0.9 ** (step + 1), 1 - 0.95 ** (step + 1)
        _adam(
            logits.ravel(), slope.ravel(), mean.ravel(), square.ravel(),
            *map(number, (0.9, 0.1, 0.95, 0.05, rate / first, 1 / second, 1e-8)),
        )  # fmt: skip


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def _adam(values, slope, mean, square, keep, take, keep_square, take_square, rate, scale, least):
    for i in range(len(values)):
        mean[i] = keep * mean[i] + take * slope[i]
        square[i] = keep_square * square[i] + take_square * slope[i] * slope[i]
        values[i] -= rate * mean[i] / (np.sqrt(scale * square[i]) + least)


@njit(cache=True, nogil=True)
@no_type_check
def ray_slope(logits, starts, spans, hits, offsets, samples, slope):
    """Add the gradient of the rays' mean binary cross entropy to `slope`; a ray without a span is
    skipped.

    Logits are interpolated trilinearly between cell centres, and constant beyond the outermost
    ones.
    """
    cells = logits.shape[0]
    flat, flat_slope = logits.ravel(), slope.ravel()  # views: both are contiguous
    # Unsigned, since Numba checks signed indices for being negative.
    along_x, along_y, along_z = np.uint64(cells * cells), np.uint64(cells), np.uint64(1)
    first = np.empty(samples, np.uint64)
    parts = np.empty((samples, 3))
    along = np.empty(samples)
    counted = 0
    for ray in range(len(hits)):
        counted += spans[ray, 0] != 0 or spans[ray, 1] != 0 or spans[ray, 2] != 0
    for ray in range(len(hits)):
        if spans[ray, 0] == 0 and spans[ray, 1] == 0 and spans[ray, 2] == 0:
            continue
        largest = -np.inf
        for i in range(samples):
            share = (i + offsets[ray]) / samples
            at = 0
            for axis in range(3):
                place = (starts[ray, axis] + share * spans[ray, axis] + 1) / 2 * cells - 0.5
                place = min(max(place, 0.0), cells - 1.0)
                corner = min(int(place), cells - 2)
                parts[i, axis] = place - corner
                at = at * cells + corner
            first[i] = at
            x, y, z = parts[i]
            value = 0.0
            for column, weight in (
                (first[i], (1 - x) * (1 - y)), (first[i] + along_y, (1 - x) * y),
                (first[i] + along_x, x * (1 - y)), (first[i] + along_x + along_y, x * y),
            ):  # fmt: skip
                value += weight * ((1 - z) * flat[column] + z * flat[column + along_z])
            along[i] = value
            largest = max(largest, value)
        total = 0.0
        for i in range(samples):
            along[i] = np.exp(SHARPNESS * (along[i] - largest))
            total += along[i]
        logit = largest + np.log(total) / SHARPNESS - np.log(samples) / (2 * SHARPNESS)
        pull = (1 / (1 + np.exp(-logit)) - hits[ray]) / (counted * total)
        for i in range(samples):
            x, y, z = parts[i]
            push = pull * along[i]
            for column, weight in (
                (first[i], (1 - x) * (1 - y)), (first[i] + along_y, (1 - x) * y),
                (first[i] + along_x, x * (1 - y)), (first[i] + along_x + along_y, x * y),
            ):  # fmt: skip
                flat_slope[column] += push * weight * (1 - z)
                flat_slope[column + along_z] += push * weight * z


@njit(cache=True, nogil=True, error_model="numpy")
@no_type_check
def regular_slope(occupancy, variation, volume, slope):
    """Gradient, with respect to the logits, of the weighted total variation and mean of the
    occupancies. The total variation is the sum over the three axes of the mean absolute difference
    of neighbours. Fastest if all arguments have the same type."""
    cells = occupancy.shape[0]
    one = occupancy.dtype.type(1)
    per_pair = variation / occupancy.dtype.type(cells * cells * (cells - 1))
    per_cell = volume / occupancy.dtype.type(cells**3)
    slope[:] = 0
    # By slices, since Numba does not vectorise loops over sums of indices.
    for x in range(cells):
        here, out = occupancy[x].ravel(), slope[x].ravel()
        if x > 0:
            _add_signs(here, occupancy[x - 1].ravel(), out)
        if x < cells - 1:
            _add_signs(here, occupancy[x + 1].ravel(), out)
        for step in (cells, 1):
            _add_signs(here[step:], here[:-step], out[step:])
            _add_signs(here[:-step], here[step:], out[:-step])
        for end in range(cells, cells * cells, cells):  # not neighbours along z: ends of rows
            sign = np.sign(here[end] - here[end - 1])
            out[end] -= sign
            out[end - 1] += sign
        for i in range(len(out)):
            out[i] = (per_pair * out[i] + per_cell) * here[i] * (one - here[i])


@njit(cache=True, nogil=True)
@no_type_check
def _add_signs(a, b, signs):
    for i in range(len(a)):
        signs[i] += np.sign(a[i] - b[i])
