"""Merges masks that are alone, by the directions and sizes in which they show a common ball.

An object that few views show, some of them without its mask, may have no filled cell: then its
masks share no surface, and each stays alone. Their middles still meet in a point, and their sizes
shrink with its distance.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from data_prep.tracks.carving import MIN_DEPTH_M, Cameras
from sceneprior.core.cameras import nearest_to_rays

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
