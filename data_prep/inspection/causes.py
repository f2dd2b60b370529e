"""Diagnoses camera errors: undoes common mistakes on trial and compares the result with masks."""

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
from data_prep.inspection.bodies import Body, found_bodies
from sceneprior.core.shards import RoomViews

Bodies = Sequence[Body | None]

CHANCE = "chance"
"""Cause under which the baseline, shuffled cameras, is listed; it is not a mistake."""
_OPENGL_AXES = np.diag(np.array([1, -1, -1, 1], dtype=np.float32))
_Z_UP = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=np.float32)
"""Rotation from a world with y up to one with z up."""


class Trial(NamedTuple):
    """Result of one repair."""

    agreement: Agreement
    factor: float = 1.0
    """Scale factor, if the repair estimates one."""


def try_repairs(bodies: Bodies, views: RoomViews) -> dict[str, Trial]:
    """Measure the agreement after each repair of a room's cameras, by cause.

    Boxes found from masks depend on the cameras, so they are found again after each repair.
    """
    found = any(body is not None and body.kind == "found" for body in bodies)
    repairs = {**_ANY, **(_OF_FOUND if found else {})}
    trials = {}
    for cause, repair in repairs.items():
        repaired = repair(views)
        if repaired is not None:
            again = found_bodies(repaired) if found else bodies
            trials[cause] = Trial(compare(again, repaired).agreement)
    for cause, measure in () if found else _OF_TRUTH.items():
        if (trial := measure(bodies, views)) is not None:
            trials[cause] = trial
    return trials


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
        if cause != CHANCE and trial.agreement.passes(kind, share, least)
    }  # fmt: skip
    if not good:
        return "is an axis or a unit wrong?"

    best = max(good, key=lambda cause: round(_how_well(good[cause]), 2))  # the first of equals
    trial = good[best]
    tally = trial.agreement.of(kind)
    text = f"{best.format(factor=trial.factor)}, {tally.share:.0%} would"
    return text + (f", with a mean 2D IoU of {tally.mean_iou:.2f}" if tally.whole else "")


def chance_of(trials: Iterable[dict[str, Trial]], kind: str) -> float:
    """Share of the masks that agree with shuffled cameras; NaN if that was not tried."""
    tallies = [tried[CHANCE].agreement.of(kind) for tried in trials if CHANCE in tried]
    masks = sum(tally.masks for tally in tallies)
    return sum(tally.held for tally in tallies) / masks if masks else float("nan")


def out_of_order(bodies: Bodies, views: RoomViews) -> tuple[np.ndarray, Comparison]:
    """Match cameras to frames one to one, so that they fit the masks best.

    Returns, for each frame, the index of the frame whose camera fits, (T,), its own if no other
    fits better; and the comparison with these cameras.
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

    Masks that fit no object are left out, as ids may have been shifted onto walls; None if the
    others are less than a quarter of all masks.
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


def _posed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[RoomViews], RoomViews]:
    return lambda views: replace(views, world_to_camera=change(views.world_to_camera))


def _transposed(poses: np.ndarray) -> np.ndarray:
    turned = poses.copy()
    turned[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return turned


def _dealt_out(poses: np.ndarray) -> np.ndarray:
    """Shuffle the poses so that no camera keeps its frame."""
    order = np.random.default_rng(0).permutation(len(poses))
    dealt = np.empty_like(poses)
    dealt[order] = poses[np.roll(order, 1)]
    return dealt


def _of_this_size(views: RoomViews) -> RoomViews | None:
    """Scale intrinsics so that the principal point becomes central; None if it already is."""
    height, width = views.image_size
    middle = views.intrinsics[:, :2, 2]
    scale = np.array([width, height]) / 2 / np.where(middle > 0, middle, np.inf)
    if (np.abs(scale - 1) < 0.1).all() or not (scale > 0).all():
        return None
    lenses = views.intrinsics.copy()
    lenses[:, :2] *= scale[..., None]
    return replace(views, intrinsics=lenses)


def _focal_factor(bodies: Bodies, views: RoomViews) -> Trial | None:
    """Estimate the scale of the focal lengths from distances of objects to the principal point."""
    height, width = views.image_size
    boxes = projections(bodies, views)
    seen = compare_boxes(bodies, boxes, views)
    rows, items = np.nonzero(seen.judged & seen.whole)
    masks, boxes = views.boxes[rows, items] * [width, height, width, height], boxes[rows, items]
    middle = views.intrinsics[rows, :2, 2]
    is_at, would_be = (((sides[:, :2] + sides[:, 2:]) / 2 - middle) for sides in (masks, boxes))
    # Near the principal point, positions hardly depend on the focal length.
    far = np.linalg.norm(would_be, axis=1) > width / 20
    ratios = (is_at * would_be).sum(axis=1)[far] / (would_be**2).sum(axis=1)[far]
    return _scaled(bodies, views, ratios, "intrinsics")


def _unit_factor(bodies: Bodies, views: RoomViews) -> Trial | None:
    """Estimate the scale of the translations at which rays through 2D boxes meet their objects."""
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
    return _scaled(bodies, views, ratios, "world_to_camera")


def _scaled(bodies: Bodies, views: RoomViews, ratios: np.ndarray, array: str) -> Trial | None:
    """Scale focal lengths or translations by the best factor near the median of `ratios`."""
    ratios = ratios[np.isfinite(ratios)]
    factor = float(np.median(ratios)) if len(ratios) else 0.0
    if factor <= 0:
        return None
    part = (slice(None), [0, 1], [0, 1]) if array == "intrinsics" else (slice(None), slice(3), 3)

    def tried(factor: float) -> Trial:
        changed = getattr(views, array).copy()
        changed[part] *= factor
        return Trial(compare(bodies, replace(views, **{array: changed})).agreement, factor)

    # Centres of 2D boxes are not exactly those of the objects, so the factor is refined.
    for step in (1.12, 1.04, 1.015):
        factor = max((tried(factor * step**k) for k in (0, -1, 1, -2, 2)), key=_how_well).factor
    return tried(factor)


def _how_well(trial: Trial) -> float:
    tallies = trial.agreement.tallies.values()
    return sum(tally.share + (tally.mean_iou if tally.whole else 0.0) for tally in tallies)


_ANY: dict[str, Callable[[RoomViews], RoomViews | None]] = {
    "world_to_camera seems to hold camera-to-world matrices; inverted": _posed(np.linalg.inv),
    "the cameras seem to have OpenGL axes (y up, z backward) instead of OpenCV's; with y and z "
    "flipped": _posed(lambda poses: _OPENGL_AXES @ poses),
    "world_to_camera seems to hold camera-to-world matrices with OpenGL axes; inverted, and with "
    "y and z flipped": _posed(lambda poses: _OPENGL_AXES @ np.linalg.inv(poses)),
    "the rotations of world_to_camera seem to be transposed; transposed back": _posed(_transposed),
    "the intrinsics seem to be those of pictures of another size; scaled to these": _of_this_size,
    CHANCE: _posed(_dealt_out),
}
"""Repairs by cause, the beginning of a sentence; a repair returns None if it does not apply."""
_OF_FOUND: dict[str, Callable[[RoomViews], RoomViews | None]] = {
    "each frame seems to have the camera of the frame before; with that of the next": _posed(
        lambda poses: np.roll(poses, -1, axis=0)
    ),
    "each frame seems to have the camera of the next; with that of the frame before": _posed(
        lambda poses: np.roll(poses, 1, axis=0)
    ),
    "the cameras seem to be in reverse order; with the first for the last": _posed(
        lambda poses: poses[::-1].copy()
    ),
}
_OF_TRUTH: dict[str, Callable[[Bodies, RoomViews], Trial | None]] = {
    "the cameras' world seems to have z up instead of y; turned": lambda bodies, views: Trial(
        compare(bodies, _posed(lambda poses: poses @ _Z_UP)(views)).agreement
    ),
    "the focal lengths seem to be wrong; times {factor:.2f}": _focal_factor,
    "the translations of the cameras seem to have another unit than the objects; times "
    "{factor:.2g}": _unit_factor,
    "frames and cameras seem to be out of order; with cameras of other frames of the room": (
        lambda bodies, views: Trial(out_of_order(bodies, views)[1].agreement)
    ),
    "the instance ids of the masks seem to be those of other objects; with ids exchanged": (
        _other_ids
    ),
}
"""Repairs that need 3D objects that do not depend on the cameras."""
