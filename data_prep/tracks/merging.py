"""Merges clusters of masks: small ones into larger ones by hulls, and masks that are alone.

A small cluster joins a larger one whose visual hull covers its rays. An object that few views show,
some of them without its mask, may have no filled cell: then its masks share no surface, and each
stays alone. Their middles still meet in a point, and their sizes shrink with its distance: masks
that show a common ball are merged.
"""

from collections.abc import Iterator
from typing import NamedTuple, no_type_check

import numpy as np
from jaxtyping import Float, Int
from numba import njit

from data_prep.tracks.carving import (
    MIN_DEPTH_M,
    Cameras,
    Grid,
    cell_at,
    direction_of,
    ids_at,
    span_of,
    votes_of,
)
from data_prep.tracks.clusters import CLASS_ERROR, class_odds, main_classes
from sceneprior.core.cameras import nearest_to_rays

LEAST_VIEWS = 2
"""Minimum number of views, other than the mask's, that must show the cluster in a hull cell."""
PAST = 0.3
"""Maximum share of views that see past a hull cell; half a view is added to the limit."""
EVERY = 2
"""Step between the rows and columns whose rays are followed."""
ENOUGH = 0.6
"""Share of a mask's rays that must meet a cluster's hull for the hull to favour joining."""
HULL, CLASS, PAIRS, SAME_VIEWS = 4.0, 1.0, 2.0, -2.0
"""Weights of the terms of the gain: hulls, classes, mean pair weight, and common views."""
FEW = 6.0
"""Gain of joining a cluster of one mask to any other cluster, since most objects are visible more
often; for a cluster of n masks, the gain is divided by n."""
LEAST = 3
"""Minimum number of views whose masks show the same ball; two rays meet too often by chance."""
OFF, LARGER = 0.6, 2.0
"""Distance of a mask's middle from the ball's, in radii of the larger one, and ratio of their
sizes, that have a misfit of 1 each."""
MISFIT = 1.5
"""Maximum misfit of a mask to a ball."""
MOST = 200
"""Maximum number of single masks of a class: more of them mean that poses are wrong, and every pair
is compared with every mask."""
_DIGITS = 6
"""Decimals of misfits, so that last bits do not matter."""


def hull_coverage(
    ids: Int[np.ndarray, "views height width"],
    near: Int[np.ndarray, "views height width"],
    labels: Int[np.ndarray, " masks"],
    cameras: Cameras,
    grid: Grid,
) -> Float[np.ndarray, "masks clusters"]:
    """Share of each mask's rays that meet each cluster's hull.

    A cell is in the hull if at least two views show the cluster there and few see background.
    Masks of other clusters do not count, since they may be in front. The hull of a mask's own
    cluster is computed without the mask's view. `near` are the ids after `widened`.
    """
    cells = np.argwhere(grid.filled)
    row_of_cell = np.full(grid.filled.shape, -1, dtype=np.int32)
    row_of_cell[tuple(cells.T)] = np.arange(len(cells))
    anywhere = np.full(ids.shape, np.inf, dtype=np.float32)
    shown = ids_at(cells, near, cameras.to_image, grid.low_m, grid.cell_m, anywhere)
    votes, past = votes_of(shown, labels), (shown == 0).sum(axis=1)[:, None]
    hulls, hulls_without = (
        (count >= LEAST_VIEWS) & (past <= PAST * (count + past) + 0.5)
        for count in (votes, votes - 1)
    )
    met, rays = _follow(
        ids, labels, cameras.eyes_m, cameras.rays, grid.low_m, grid.cell_m, row_of_cell, hulls,
        hulls_without,
    )  # fmt: skip
    return met / np.maximum(rays, 1)[:, None]


# no_type_check: functions compiled by Numba have no annotations.
@njit(cache=True, nogil=True)
@no_type_check
def _follow(ids, labels, eyes_m, rays, low_m, cell_m, row_of_cell, hulls, hulls_without):
    """Numbers of each mask's rays that meet each cluster's hull, and of all its rays;
    `hulls_without` are the hulls computed without one view."""
    views, height, width = ids.shape
    clusters = hulls.shape[1]
    met, count = np.zeros((len(labels), clusters)), np.zeros(len(labels))
    passed = np.zeros(clusters, np.bool_)
    for view, half_y, half_x in np.ndindex((views, -(-height // EVERY), -(-width // EVERY))):
        y, x = half_y * EVERY, half_x * EVERY
        mask = ids[view, y, x] - 1
        if mask < 0:
            continue
        count[mask] += 1
        passed[:] = False
        eye, direction = eyes_m[view], direction_of(rays[view], y, x)
        near, far, length = span_of(eye, direction, low_m, cell_m, row_of_cell.shape)
        stride = 0.7 * cell_m / length
        t = near + 0.5 * stride
        last = -1
        while t < far:
            cell = cell_at(eye, direction, t, low_m, cell_m, row_of_cell.shape)
            t += stride
            row = row_of_cell[cell] if cell[0] >= 0 else -1
            if row < 0 or row == last:
                continue
            last = row
            for other in range(clusters):
                own = other == labels[mask]
                passed[other] |= hulls_without[row, other] if own else hulls[row, other]
        met[mask] += passed
    return met, count


def merge_clusters(
    labels: Int[np.ndarray, " masks"],
    share: Float[np.ndarray, "masks clusters"],
    weights: Float[np.ndarray, "masks masks"],
    mask_view: Int[np.ndarray, " masks"],
    mask_class: Int[np.ndarray, " masks"],
) -> Int[np.ndarray, " masks"]:
    """Merge each cluster, the smallest first, into the larger one with the largest positive gain.

    With the mean share s of the smaller cluster's rays that meet the larger cluster's hull, the
    gain is the sum of

    - HULL times (s - ENOUGH) / (1 - ENOUGH) if s is above ENOUGH, else HULL times 3 (s - ENOUGH),
    - CLASS times the log-odds of the classes,
    - PAIRS times the mean weight of pairs of masks in different views,
    - SAME_VIEWS times the share of the smaller cluster's views that show both clusters, and
    - FEW divided by the smaller cluster's number of masks.
    """
    count = int(labels.max()) + 1
    size = np.bincount(labels, minlength=count)
    masks_in = np.zeros((count, int(mask_view.max()) + 1), dtype=np.int64)
    np.add.at(masks_in, (labels, mask_view), 1)
    member = np.eye(count)[labels]
    between = np.where(mask_view[:, None] == mask_view, 0.0, weights)
    mean = member.T @ between @ member / np.maximum(size[:, None] * size, 1)
    main = main_classes(labels, mask_class)
    equal, unequal = class_odds(mask_class, CLASS_ERROR)
    into = np.arange(count)
    for k in np.argsort(size, kind="stable").tolist():
        own = labels == k
        open_to = (into == np.arange(count)) & (size >= max(2, size[k]))
        open_to[k] = False
        above = (share[own].mean(axis=0) - ENOUGH) / (1 - ENOUGH)
        alike = (mask_class[own][:, None] == main).mean(axis=0)
        common = ((masks_in[k] > 0) & (masks_in > 0)).sum(axis=1) / (masks_in[k] > 0).sum()
        gain = (
            HULL * np.where(above > 0, above, 3 * above * (1 - ENOUGH))
            + CLASS * (alike * equal + (1 - alike) * unequal)
            + PAIRS * mean[k]
            + SAME_VIEWS * common
            + FEW / size[k]
        )
        gain[~open_to] = -np.inf
        best = int(gain.argmax())
        if gain[best] > 0:
            into[k] = best
            masks_in[best] += masks_in[k]
            size[best] += size[k]
    while (into[into] != into).any():
        into = into[into]
    joined: Int[np.ndarray, " masks"] = np.unique(into[labels], return_inverse=True)[1]
    return joined


class Discs(NamedTuple):
    """Discs in place of masks."""

    eyes_m: Float[np.ndarray, "discs 3"]
    rays: Float[np.ndarray, "discs 3"]
    """Unit vectors from the eyes through the middles of the masks."""
    radii: Float[np.ndarray, " discs"]
    """Radii of discs with the masks' areas, divided by the focal length; 0 without pixels."""


def discs_of(
    ids: Int[np.ndarray, "views height width"],
    mask_view: Int[np.ndarray, " masks"],
    cameras: Cameras,
) -> Discs:
    """The disc of each mask."""
    count = len(mask_view)
    _, y, x = at = np.nonzero(ids > 0)
    mask = ids[at] - 1
    pixels = np.bincount(mask, minlength=count)
    u, v = (np.bincount(mask, side + 0.5, count) / np.maximum(pixels, 1) for side in (x, y))
    through = np.stack([u, v, np.ones(count)], axis=1)
    rays = np.einsum("mij,mj->mi", cameras.rays[mask_view], through)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    radii = np.sqrt(pixels / np.pi) / cameras.focal_px[mask_view]
    return Discs(cameras.eyes_m[mask_view], rays, radii)


class Balls(NamedTuple):
    """Balls in the room."""

    middles_m: Float[np.ndarray, "balls 3"]
    radii_m: Float[np.ndarray, " balls"]


def balls_of(discs: Discs, pairs: Int[np.ndarray, "pairs 2"]) -> Balls:
    """The ball that both discs of each pair show.

    Its middle is nearest to both rays, and its radius is the mean of what both discs say.
    """
    middles_m = nearest_to_rays(discs.eyes_m[pairs], discs.rays[pairs], 1e-9)
    far_m = np.linalg.norm(middles_m[:, None] - discs.eyes_m[pairs], axis=2)
    return Balls(middles_m, (discs.radii[pairs] * np.maximum(far_m, MIN_DEPTH_M)).mean(axis=1))


def misfits(balls: Balls, discs: Discs) -> Float[np.ndarray, "balls discs"]:
    """Misfit of each disc to each ball; inf if the ball is behind the camera.

    With the angle between the middles of disc and ball, divided by the larger radius, the misfit is
    the sum of the squares of this distance divided by OFF, and of the logarithm of the ratio of the
    radii divided by that of LARGER.
    """
    eyes, rays = discs.eyes_m, discs.rays
    ahead = balls.middles_m @ rays.T - (eyes * rays).sum(axis=1)
    squared = (balls.middles_m**2).sum(axis=1)[:, None] - 2 * balls.middles_m @ eyes.T
    far_m = np.sqrt(np.maximum(squared + (eyes**2).sum(axis=1), MIN_DEPTH_M**2))
    radii = balls.radii_m[:, None] / far_m
    angle = np.arccos(np.clip(ahead / far_m, -1, 1))
    off = angle / np.maximum(radii, discs.radii) / OFF
    larger = np.log(radii / discs.radii) / np.log(LARGER)
    return np.where(ahead > 0, off**2 + larger**2, np.inf).round(_DIGITS)


def merge_singletons(
    labels: Int[np.ndarray, " masks"],
    discs: Discs,
    mask_view: Int[np.ndarray, " masks"],
    mask_class: Int[np.ndarray, " masks"],
) -> Int[np.ndarray, " masks"]:
    """Merge masks of one class that are alone in their clusters, and that show the same ball.

    Of the balls of all pairs, the one that most views show is chosen, and of those the one with the
    smallest mean misfit. Its masks are joined, and the next ball is chosen from the others. If a
    class has more than `MOST` single masks, they stay alone.
    """
    labels = labels.copy()
    alone = (np.bincount(labels)[labels] == 1) & (discs.radii > 0)
    for name in np.unique(mask_class[alone]).tolist():
        own = np.flatnonzero(alone & (mask_class == name))
        if len(own) > MOST:
            continue
        for joined in _groups(Discs(*(each[own] for each in discs)), mask_view[own]):
            labels[own[joined]] = labels[own[joined[0]]]
    renumbered: Int[np.ndarray, " masks"] = np.unique(labels, return_inverse=True)[1]
    return renumbered


def _groups(discs: Discs, view: Int[np.ndarray, " discs"]) -> Iterator[Int[np.ndarray, " joined"]]:
    """Indices of discs that show the same ball, group by group."""
    pairs = np.argwhere(view[:, None] < view)
    misfit = misfits(balls_of(discs, pairs), discs)
    shows = misfit <= MISFIT
    in_view = view[:, None] == np.unique(view)
    while True:
        # A ball whose own discs are joined already counts no more.
        whole = shows[np.arange(len(pairs))[:, None], pairs].all(axis=1)
        pairs, misfit, shows = pairs[whole], misfit[whole], shows[whole]
        views = (shows.astype(np.float32) @ in_view.astype(np.float32) > 0).sum(axis=1)
        if views.max(initial=0) < LEAST:
            break
        mean = np.where(shows, misfit, 0.0).sum(axis=1) / shows.sum(axis=1)
        best = int(np.lexsort([mean, -views])[0])
        joined = np.flatnonzero(shows[best])
        yield joined
        shows[:, joined] = False
