"""Finds faults in the arrays of one room, and describes each in a sentence."""

from collections.abc import Iterator

import numpy as np

from sceneprior.core.classes import VOID
from sceneprior.core.observations import RoomGroundTruth, RoomViews, observe


def array_problems(views: RoomViews, classes: int) -> Iterator[str]:
    """Report values out of range in the views; `Shard.read_room` has checked that they are
    finite."""
    if (views.object_class < 1).any():
        yield f"a class index is outside 1 to {classes - 1}"
    turn = views.world_to_camera[:, :3, :3].astype(np.float64)
    off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
    flat = np.abs(views.world_to_camera[:, 3] - (0, 0, 0, 1)).max(axis=1, initial=0)
    good = (off < 1e-3) & (flat < 1e-6) & (np.linalg.det(turn) > 0)
    if not good.all():
        yield f"the camera of view {int(np.argmin(good))} is no rotation with a translation"
    K = views.intrinsics
    pinhole = (K[:, (0, 1), (0, 1)] > 0).all(axis=1)
    pinhole &= (K[:, (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)] == (0, 0, 0, 0, 1)).all(axis=1)
    if not pinhole.all():
        yield f"the intrinsics of view {int(np.argmin(pinhole))} are not those of a pinhole camera"
    if not ((views.boxes >= 0) & (views.boxes <= 1)).all():
        yield "a 2D box reaches beyond the image"
    if (views.boxes[~views.visible] != 0).any() or (views.mask_pixels[~views.visible] != 0).any():
        yield "an object that is not visible in a view has a box or pixels there"
    if not views.visible.any(axis=0).all():
        yield f"no view shows object {int(np.argmin(views.visible.any(axis=0)))}"


def mask_problems(views: RoomViews) -> Iterator[str]:
    """Report the first 2D box, pixel count or clear side that disagrees with its mask."""
    assert views.instance_ids is not None
    # All objects get a class other than void, because void masks are not measured.
    seen = observe(views.instance_ids, [VOID + 1] * len(views.object_class) + [VOID])
    visible, boxes, pixels, clear = (
        np.zeros_like(getattr(views, name))
        for name in ("visible", "boxes", "mask_pixels", "sides_clear")
    )
    visible[:, seen.tracked], boxes[:, seen.tracked] = seen.visible, seen.boxes
    pixels[:, seen.tracked], clear[:, seen.tracked] = seen.mask_pixels, seen.sides_clear
    for view, k in np.argwhere(visible != views.visible)[:1]:
        mask = np.argwhere(views.instance_ids[view] == k + 1)
        height, width = np.ptp(mask, axis=0) + 1 if len(mask) else (0, 0)
        said = "visible" if views.visible[view, k] else "not visible"
        size = f"{width} x {height} pixels"
        yield f"view {view}, object {k} is said to be {said}, but its mask is {size}"
        return
    for view, k in np.argwhere((boxes != views.boxes).any(axis=2) & visible)[:1]:
        yield f"view {view}, object {k}: its 2D box does not fit its mask"
        return
    for view, k in np.argwhere((pixels != views.mask_pixels) & visible)[:1]:
        said = f"{pixels[view, k]} pixels, mask_pixels says {views.mask_pixels[view, k]}"
        yield f"view {view}, object {k}: its mask has {said}"
        return
    # Objects too narrow to be visible in any view (and, in shards of version 1, void furniture) are
    # 0 in the image but can touch a side: fewer sides may be clear.
    for view, k in np.argwhere((views.sides_clear & ~clear).any(axis=2) & visible)[:1]:
        touched = "another object touches a side of its box that is said to be clear"
        yield f"view {view}, object {k}: {touched}"


def truth_problems(views: RoomViews, truth: RoomGroundTruth) -> Iterator[str]:
    """Report ground truth that is inconsistent in itself or with the tracked objects.

    `Shard.read_ground_truth` has checked that its numbers are finite and its arrays equally long.
    """
    if truth.unoccluded is not None and truth.unoccluded.shape != views.visible.shape:
        came = truth.unoccluded.shape
        yield f"ground truth: unoccluded has shape {came}, expected {views.visible.shape}"
    if not np.array_equal(truth.object_class[: len(views.object_class)], views.object_class):
        yield "ground truth: its first rows are not the tracked objects"
    if (truth.sizes_m < 0).any():
        yield "ground truth: a size is negative"
