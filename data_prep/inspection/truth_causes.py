"""Finds the reason why ground truth and masks disagree, by trying to repair likely mistakes."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_prep.inspection.agreement import (
    Agreement,
    Comparison,
    compare,
    compare_boxes,
    projections,
)
from data_prep.inspection.bodies import Body
from data_prep.inspection.causes import CHANCE, GIVEN, corrected
from data_prep.inspection.given import Given
from data_prep.inspection.words import of_cause
from sceneprior.core.shards import RoomViews

Bodies = Sequence[Body | None]

_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float32)
"""Rotation from a world with y up to a world with z up."""


class Trial(NamedTuple):
    """Result of one repair."""

    agreement: Agreement
    factor: float = 1.0
    """Scale factor, if the repair estimates one."""


def try_repairs(bodies: Bodies, views: RoomViews, given: Given) -> dict[str, Trial]:
    """Measure the agreement after each repair of a room, by cause."""
    tried: dict[str, Trial | None] = {}
    for cause, (poses, lenses) in corrected(views, given.convention).items():
        if cause.family not in (GIVEN.family, CHANCE.family, "center"):
            other = replace(views, world_to_camera=poses, intrinsics=lenses)
            name = f"{of_cause(cause, given)}; corrected"
            tried[name] = Trial(compare(bodies, other).agreement)
    tried |= {cause: repair(bodies, views) for cause, repair in _REPAIRS.items()}
    return {cause: trial for cause, trial in tried.items() if trial is not None}


def likely_cause(
    trials: Iterable[dict[str, Trial]], kind: str, share: float = 1.0, least: int = 1
) -> str:
    """Name the mistake whose repair makes the masks agree (`passes`), as the end of a sentence."""
    sums: dict[str, Trial] = {}
    for tried in trials:
        for cause, trial in tried.items():
            before = sums.get(cause, Trial(Agreement(), trial.factor))
            # The factors of different rooms differ by less than is printed: keep the first.
            sums[cause] = Trial(before.agreement + trial.agreement, before.factor)
    good = {
        cause: trial for cause, trial in sums.items()
        if trial.agreement.passes(kind, share, least)
    }  # fmt: skip
    if not good:
        return "is an axis or a unit wrong?"
    best = max(good, key=lambda cause: round(_how_well(good[cause]), 2))  # the first of equals
    trial = good[best]
    tally = trial.agreement.of(kind)
    text = f"{best.format(factor=trial.factor)}, {tally.share:.0%} would"
    return text + (f", with a mean 2D IoU of {tally.mean_iou:.2f}" if tally.whole else "")


def out_of_order(bodies: Bodies, views: RoomViews) -> tuple[np.ndarray, Comparison]:
    """Match cameras to frames one to one, so that they fit the masks best.

    Returns, for each frame, the index of the frame whose camera fits best, (T,), which is its own
    if no other fits better; and the comparison with these cameras.
    """
    boxes = projections(bodies, views)[:, None]  # one per camera, the same for all frames
    frames = len(views.visible)
    boxes = np.broadcast_to(boxes, (frames, frames, *boxes.shape[2:]))
    pairs = compare_boxes(bodies, boxes, views)
    gain = ((pairs.held + pairs.iou) * pairs.judged).sum(axis=-1) + 1e-3 * np.eye(frames)
    order = linear_sum_assignment(gain.T, maximize=True)[1]
    moved = [
        body if body is None or body.unoccluded is None
        else body._replace(unoccluded=body.unoccluded[order])
        for body in bodies
    ]  # fmt: skip
    return order, compare_boxes(moved, boxes[order, 0], views)


def _other_ids(bodies: Bodies, views: RoomViews) -> Trial | None:
    """Match masks to the objects that they fit best.

    Masks that fit no object are left out, because ids may have been shifted onto walls; None if
    fewer than a quarter of all masks remain.
    """
    boxes = projections(bodies, views)
    pairs = [
        compare_boxes(bodies, np.broadcast_to(boxes[:, k : k + 1], boxes.shape), views)
        for k in range(len(bodies))
    ]
    seen = views.visible.sum(axis=0)
    held = np.stack([(pair.held & views.visible).sum(axis=0) for pair in pairs], axis=1)
    iou = np.stack([(pair.iou * views.visible).sum(axis=0) for pair in pairs], axis=1)
    rows, others = linear_sum_assignment(held + iou, maximize=True)
    fits = held[rows, others] > seen / 2
    if seen[fits].sum() < seen.sum() / 4:
        return None
    exchanged = [bodies[other] if fit else None for other, fit in zip(others, fits, strict=True)]
    return Trial(compare(exchanged, views).agreement)


def _unit_factor(bodies: Bodies, views: RoomViews) -> Trial | None:
    """Estimate the scale of the translations from rays through 2D boxes, which must meet their
    objects."""
    height, width = views.image_size
    pairs = np.argwhere(compare(bodies, views).judged)
    if not len(pairs):
        return None
    rows, items = pairs.T
    centers = np.array(
        [
            np.zeros(3) if body is None
            else (body.hull.points_m.min(axis=0) + body.hull.points_m.max(axis=0)) / 2
            for body in bodies
        ]
    )[items]  # fmt: skip
    middles = (views.boxes[rows, items, :2] + views.boxes[rows, items, 2:]) / 2 * [width, height]
    pixels = np.concatenate([middles, np.ones((len(rows), 1))], axis=1)
    rays = np.linalg.solve(views.intrinsics[rows].astype(np.float64), pixels[..., None])[..., 0]
    poses = views.world_to_camera[rows].astype(np.float64)
    across = np.cross(rays, poses[:, :3, 3])
    off = np.cross(rays, (poses[:, :3, :3] @ centers[..., None])[..., 0])
    length = (across**2).sum(axis=1)
    ratios = -(across * off).sum(axis=1) / np.where(length > 0, length, np.nan)
    ratios = ratios[np.isfinite(ratios)]
    factor = float(np.median(ratios)) if len(ratios) else 0.0
    if factor <= 0:
        return None

    def tried(factor: float) -> Trial:
        poses = views.world_to_camera.copy()
        poses[:, :3, 3] *= factor
        return Trial(compare(bodies, replace(views, world_to_camera=poses)).agreement, factor)

    # Centres of 2D boxes are not exactly those of the objects, so the factor is refined.
    for step in (1.12, 1.04, 1.015):
        factor = max((tried(factor * step**k) for k in (0, -1, 1, -2, 2)), key=_how_well).factor
    return tried(factor)


def _how_well(trial: Trial) -> float:
    tallies = trial.agreement.tallies.values()
    return sum(tally.share + (tally.mean_iou if tally.whole else 0.0) for tally in tallies)


def _turned(bodies: Bodies, views: RoomViews) -> Trial:
    return Trial(
        compare(bodies, replace(views, world_to_camera=views.world_to_camera @ _Z_UP)).agreement
    )


_REPAIRS: dict[str, Callable[[Bodies, RoomViews], Trial | None]] = {
    "the cameras' world seems to have z up instead of y; turned": _turned,
    "the translations of the cameras seem to have another unit than the objects; times "
    "{factor:.2g}": _unit_factor,
    "frames and cameras seem to be out of order; with cameras of other frames of the room": (
        lambda bodies, views: Trial(out_of_order(bodies, views)[1].agreement)
    ),
    "the instance ids of the masks seem to be those of other objects; with ids exchanged": (
        _other_ids
    ),
}
"""Repairs by cause, the beginning of a sentence; a repair returns None if it does not apply."""
