"""Label what each camera saw: instance-id images in, 2D boxes, visibility and tracks out."""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

MIN_BOX_SIDE_PX = 4
"""A mask whose box is this narrow, or narrower, is not visible in that view."""


@dataclass(frozen=True)
class Observations:
    """T views of the n objects that at least one view shows."""

    tracked: np.ndarray
    """(n,) which of the given objects these are, in their order."""
    instance_ids: np.ndarray
    """(T, H, W) uint8 (uint16 past 255 objects): 0 = nothing, k + 1 = tracked object k."""
    boxes: np.ndarray
    """(T, n, 4) float32, x1, y1, x2, y2 in [0, 1]; zeros where not visible."""
    visible: np.ndarray
    """(T, n) bool."""
    mask_pixels: np.ndarray
    """(T, n) int32, 0 where not visible."""


def pixel_counts(image: np.ndarray, count: int) -> np.ndarray:
    """(count,) pixels of each object in one instance-id image."""
    return np.bincount(image.ravel(), minlength=count + 1)[1 : count + 1]


def observe(images: np.ndarray, is_object: np.ndarray) -> Observations:
    """Measure every mask, and number anew the objects that are ever visible.

    Args:
        images: (T, H, W) unsigned ids, k + 1 for mesh k.
        is_object: (meshes,) false for furniture outside the label set, which hides what is
            behind it but is itself nothing: its pixels become 0.

    Returns:
        What was seen. A mask too narrow to count keeps its pixels in the image.
    """
    views, height, width = images.shape
    is_object = np.asarray(is_object, dtype=bool)
    meshes = len(is_object)
    boxes = np.zeros((views, meshes, 4), dtype=np.float32)
    visible = np.zeros((views, meshes), dtype=bool)
    pixels = np.zeros((views, meshes), dtype=np.int32)
    for view, image in enumerate(images):
        counts = pixel_counts(image, meshes)
        for k, found in enumerate(ndimage.find_objects(image, max_label=meshes)):
            if found is None or not is_object[k]:
                continue
            rows, columns = found
            if min(rows.stop - rows.start, columns.stop - columns.start) <= MIN_BOX_SIDE_PX:
                continue
            visible[view, k] = True
            pixels[view, k] = counts[k]
            boxes[view, k] = (
                columns.start / width,
                rows.start / height,
                columns.stop / width,
                rows.stop / height,
            )
    tracked = np.flatnonzero(visible.any(axis=0))
    number = np.zeros(meshes + 1, dtype=np.uint8 if len(tracked) <= 255 else np.uint16)
    number[tracked + 1] = np.arange(1, len(tracked) + 1)
    return Observations(
        tracked, number[images], boxes[:, tracked], visible[:, tracked], pixels[:, tracked]
    )
