"""Fits the parts of each prototype, and finds the look that best explains each object's rays."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float, Int
from rich.console import Console
from rich.progress import track

from sceneprior.core.parts import Parts
from sceneprior.lifted.lifting import RayPool
from sceneprior.lifted.lifting.part_fit import fit_parts
from sceneprior.lifted.lifting.part_rays import count_wrong
from sceneprior.lifted.prototypes import (
    ALIKE,
    POSES,
    Prototypes,
    pose_distances,
    pose_rotation,
    turned_extents,
)
from sceneprior.render.silhouettes.cpu.kernels import in_threads, thread_count

RAYS = 4096
"""Number of rays to which the parts of a prototype are fitted."""
MOST = 16
"""Maximum number of (object, pose) pairs whose rays are used for a prototype."""
SYMMETRIC = 0.05
"""Margin over an object's smallest distance to the prototype within which other poses are used,
too, as for symmetric objects."""
ASKED = 128
"""Number of an object's rays from which its look is found."""
SIZE_WEIGHT = 0.1
"""Weight of the difference in log extents; see `explain_rays`."""


def fit_prototypes(
    items: Int[np.ndarray, " prototypes"],
    hulls: Bool[np.ndarray, "objects x y z"],
    rays: RayPool,
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
    usable: Bool[np.ndarray, " objects"],
    hangs: Bool[np.ndarray, " objects"],
    margin: float,
) -> tuple[Parts, ...]:
    """Fit parts to the prototypes, which are the objects `items`.

    The parts of a prototype are fitted to the rays of all objects of its class that are similar to
    it (`ALIKE`), each in its most similar pose and, for symmetric objects, in other poses that are
    nearly as similar (`SYMMETRIC`). Objects with `hangs` are held from above.
    """

    def fit_one(item: int) -> Parts:
        rows = np.flatnonzero((object_class == object_class[item]) & usable)
        apart = pose_distances(
            (hulls[rows], sizes_m[rows]), (hulls[item, None], sizes_m[item, None])
        )[:, 0]
        other_poses = apart > apart.min(axis=1, keepdims=True) + SYMMETRIC
        apart = np.where(other_poses | (apart > ALIKE), np.inf, apart)
        near = np.argsort(apart, axis=None, kind="stable")[:MOST]
        near = near[np.isfinite(apart.ravel()[near])]
        # A generator per prototype makes the result independent of the number of threads.
        rng = np.random.default_rng([1, item])
        count = min(-(-RAYS // len(near)), rays.hits.shape[1])
        pools = []
        for row, pose in zip(*np.unravel_index(near, apart.shape), strict=True):
            some = rng.choice(rays.hits.shape[1], count, replace=False)
            pool = RayPool(*(part[rows[row], some] for part in rays))
            pools.append(as_prototype(pool, int(pose)))
        order = rng.permutation(len(pools) * count)
        pool = RayPool(*(np.concatenate(part)[order] for part in zip(*pools, strict=True)))
        return fit_parts(pool, hulls[item], margin, bool(hangs[item]))

    with ThreadPoolExecutor(thread_count()) as pool:
        found = pool.map(fit_one, items.tolist())
        words, console = "finding parts from masks (kinds)", Console(stderr=True)
        return tuple(track(found, words, total=len(items), console=console))


def as_prototype(rays: RayPool, pose: int) -> RayPool:
    """Transform an object's rays to the frame of a prototype that the object shows in this pose."""
    starts, spans = (part.astype(np.float64) @ pose_rotation(pose) for part in rays[:2])
    return RayPool(starts, spans, rays.hits)


def explain_rays(
    prototypes: Prototypes,
    rays: RayPool,
    sizes_m: Float[np.ndarray, "objects 3"],
    object_class: Int[np.ndarray, " objects"],
    margin: float,
) -> tuple[Int[np.ndarray, " objects"], Float[np.ndarray, "objects poses"]]:
    """The look of each object: the prototype of its class and the pose that minimise its error,

        share of the object's rays explained wrongly + `SIZE_WEIGHT` (L1 distance of log extents).

    Ties give the first look.

    Returns:
        The looks, -1 if the object's class has no prototype; and the errors of each object's
        prototype in all poses, 0 for objects without one.
    """
    looks = np.full(len(object_class), -1, dtype=np.int64)
    errors = np.zeros((len(object_class), POSES))
    offered = {}
    for label in np.unique(prototypes.object_class):
        own = np.flatnonzero(prototypes.object_class == label)
        solids = [list(prototypes.parts[row].solids()) for row in own]
        ends = np.stack([ends for each in solids for _, ends in each]) * (2 / margin)
        kinds = np.array([kind for each in solids for kind, _ in each])
        first = np.cumsum([0, *map(len, solids)])
        lows, highs = np.ascontiguousarray(np.moveaxis(ends, 2, 0))
        outlines = [prototypes.parts[row].outline for row in own]
        corners = np.concatenate(outlines) * (2 / margin)
        first_corners = np.cumsum([0, *map(len, outlines)])
        offered[int(label)] = own, (kinds, lows, highs, first, corners, first_corners)

    def ask_some(first: int, last: int) -> None:
        for item in range(first, last):
            if (label := int(object_class[item])) not in offered:
                continue
            own, solids = offered[label]
            asked = RayPool(*(part[item, :ASKED] for part in rays))
            posed = [as_prototype(asked, pose) for pose in range(POSES)]
            sizes = [turned_extents(np.log(prototypes.sizes_m[own]), pose) for pose in range(POSES)]
            differ = SIZE_WEIGHT * np.abs(np.log(sizes_m[item]) - sizes).sum(axis=2).T
            row = int(differ.argmin()) // POSES
            best = _errors(posed, differ, solids, row, row + 1, np.inf).min()
            found = _errors(posed, differ, solids, 0, len(own), best)
            row = int(found.argmin()) // POSES
            errors[item] = _errors(posed, differ, solids, row, row + 1, np.inf)
            looks[item] = own[row] * POSES + int(found[row].argmin())

    in_threads(ask_some, len(looks))
    return looks, errors


def _errors(
    posed: Sequence[RayPool],
    differ: Float[np.ndarray, "prototypes poses"],
    solids: tuple[np.ndarray, ...],
    start: int,
    stop: int,
    best: float,
) -> Float[np.ndarray, "some poses"]:
    """Errors of the prototypes from `start` to before `stop` in all poses. Those larger than
    `best`, or than a smaller error in an earlier pose, are infinite and take little time; an
    infinite `best` gives all errors."""
    kinds, lows, highs, first, corners, first_corners = solids
    found = differ[start:stop].copy()
    counts = np.empty(stop - start, np.int64)
    for pose, rays in enumerate(posed):
        most = np.ceil((best - found[:, pose]) * ASKED)
        count_wrong(
            *rays, kinds, lows, highs, first[start : stop + 1], corners,
            first_corners[start : stop + 1], most, counts,
        )  # fmt: skip
        found[:, pose] += np.where(counts > most, np.inf, counts / ASKED)
        if best < np.inf:
            best = min(best, found[:, pose].min())
    return found
