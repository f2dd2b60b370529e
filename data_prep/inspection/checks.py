"""Finds faults in the arrays of one room, as sentences."""

from collections.abc import Iterator

import numpy as np
from scipy import ndimage

from sceneprior.core.instances.observations import MIN_BOX_SIDE_PX, clear_sides, pixel_counts
from sceneprior.core.shards import RoomGroundTruth, RoomViews


def array_problems(views: RoomViews, classes: int) -> Iterator[str]:
    """Report values out of range in the views."""
    known = views.object_class
    if ((known < 1) | (known >= classes)).any():
        yield f"a class index is outside 1 to {classes - 1}"
    turn = views.world_to_camera[:, :3, :3].astype(np.float64)
    off = np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
    flat = np.abs(views.world_to_camera[:, 3] - (0, 0, 0, 1)).max(axis=1, initial=0)
    # Written so that NaN counts as a fault.
    with np.errstate(invalid="ignore"):
        good = (off < 1e-3) & (flat < 1e-6) & (np.linalg.det(turn) > 0)
    if not (good & np.isfinite(views.world_to_camera).all(axis=(1, 2))).all():
        yield f"the camera of view {int(np.argmin(good))} is no rotation with a translation"
    K = views.intrinsics
    pinhole = (K[:, (0, 1), (0, 1)] > 0).all(axis=1) & np.isfinite(K).all(axis=(1, 2))
    pinhole &= (K[:, (0, 1, 2, 2, 2), (1, 0, 0, 1, 2)] == (0, 0, 0, 0, 1)).all(axis=1)
    if not pinhole.all():
        yield f"the intrinsics of view {int(np.argmin(pinhole))} are those of no pinhole"
    if not ((views.boxes >= 0) & (views.boxes <= 1)).all():
        yield "a 2D box reaches beyond the image"
    if (views.boxes[~views.visible] != 0).any() or (views.mask_pixels[~views.visible] != 0).any():
        yield "an object that is not visible in a view has a box or pixels there"
    if not views.visible.any(axis=0).all():
        yield f"no view shows object {int(np.argmin(views.visible.any(axis=0)))}"


def mask_problems(views: RoomViews) -> Iterator[str]:
    """Report 2D boxes, pixel counts and clear sides that disagree with the masks."""
    assert views.instance_ids is not None
    height, width = views.image_size
    objects = len(views.object_class)
    for view, image in enumerate(views.instance_ids):
        counts = pixel_counts(image, objects)
        for k, found in enumerate(ndimage.find_objects(image, max_label=objects)):
            rows, columns = found or (slice(0, 0), slice(0, 0))
            sides = rows.stop - rows.start, columns.stop - columns.start
            what = f"view {view}, object {k}"
            if bool(views.visible[view, k]) != (min(sides) > MIN_BOX_SIDE_PX):
                said = "visible" if views.visible[view, k] else "not visible"
                yield f"{what} is said to be {said}, but its mask is {sides[1]} x {sides[0]} pixels"
                return
            if not views.visible[view, k]:
                continue
            box = np.array(
                [columns.start / width, rows.start / height, columns.stop / width,
                 rows.stop / height], dtype=np.float32,
            )  # fmt: skip
            if (box != views.boxes[view, k]).any():
                yield f"{what}: its 2D box does not fit its mask"
                return
            if counts[k] != views.mask_pixels[view, k]:
                yield (
                    f"{what}: its mask has {counts[k]} pixels, mask_pixels says "
                    f"{views.mask_pixels[view, k]}"
                )
                return
            # Objects too narrow to be visible in any view (and, in shards of version 1, void
            # furniture) are 0 in the image but can touch a side: fewer sides may be clear.
            if (views.sides_clear[view, k] & ~np.array(clear_sides(image, k + 1, *found))).any():
                yield f"{what}: another object touches a side of its box that is said to be clear"
                return


def truth_problems(views: RoomViews, truth: RoomGroundTruth) -> Iterator[str]:
    """Report ground truth that is inconsistent in itself or with the tracked objects."""
    rows, tracked = len(truth.object_class), len(views.object_class)
    expected = {
        "centers_m": (rows, 3), "sizes_m": (rows, 3), "yaw_rad": (rows,),
        "model_to_room": (rows, 4, 4),
    }  # fmt: skip
    if truth.unoccluded is not None and truth.unoccluded.shape != views.visible.shape:
        came = truth.unoccluded.shape
        yield f"ground truth: unoccluded has shape {came}, expected {views.visible.shape}"
    for name, shape in expected.items():
        if getattr(truth, name).shape != shape:
            yield f"ground truth: {name} has shape {getattr(truth, name).shape}, expected {shape}"
        elif not np.isfinite(getattr(truth, name)).all():
            yield f"ground truth: {name} is not finite"
    if len(truth.model_ids) != rows:
        yield f"ground truth: {rows} objects, but {len(truth.model_ids)} model ids"
    if not np.array_equal(truth.object_class[:tracked], views.object_class):
        yield "ground truth: its first rows are not the tracked objects"
    if (truth.sizes_m < 0).any():
        yield "ground truth: a size is negative"
