"""2D boxes, visibility and tracks of objects in images of instance ids."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from scipy import ndimage

from sceneprior.core.classes import VOID
from sceneprior.core.shards import RoomViews, Sightings, thinned_stuff

MIN_BOX_SIDE_PX = 4
"""Limit on the sides of a mask's box, in pixels: an object counts as visible in a view if both
sides are longer."""

TOUCH_PX = 4
"""Distance in pixels within which another object counts as touching a side of a mask, so that it
may occlude the masked object."""


@dataclass(frozen=True)
class Observations(Sightings):
    """Observations of the given objects that are visible in at least one view."""

    instance_ids: np.ndarray
    tracked: np.ndarray
    """(n,) indices of the visible objects among the given ones, ascending."""
    unseen: np.ndarray
    """Indices of the given objects that are visible in no view."""

    def room_views(
        self,
        room_id: str,
        world_to_camera: np.ndarray,
        intrinsics: np.ndarray,
        stuff: np.ndarray | None = None,
    ) -> RoomViews:
        """Convert to the views of a room in a shard; `intrinsics` may be (3, 3) for all views.

        `stuff` has indices into `STUFF` at the pixels of `thinned_stuff`; it is kept where no
        object is, and not at all if none is known.
        """
        views, height, width = self.instance_ids.shape
        if stuff is not None:
            stuff = stuff * (thinned_stuff(self.instance_ids) == 0) if stuff.any() else None
        return RoomViews(
            **{item.name: getattr(self, item.name) for item in fields(Sightings)},
            room_id=room_id,
            world_to_camera=world_to_camera.astype(np.float32),
            intrinsics=np.array(np.broadcast_to(intrinsics, (views, 3, 3)), dtype=np.float32),
            image_size=(height, width),
            stuff=stuff,
        )


def pixel_counts(image: np.ndarray, count: int) -> np.ndarray:
    """Number of pixels of each object in one instance-id image, (count,)."""
    return np.bincount(image.ravel(), minlength=count + 1)[1 : count + 1]


def observe(images: np.ndarray, classes: np.ndarray | Sequence[int]) -> Observations:
    """Measure all masks, and renumber the objects that are visible in at least one view.

    Images are (T, H, W) unsigned ids, k + 1 for given object k. An object that is visible in some
    view keeps its pixels in all images, even where its mask is too narrow to count as visible.
    Furniture of class void is not tracked but may occlude objects, so its pixels get the id after
    the last object's.
    """
    views, height, width = images.shape
    classes = np.asarray(classes, dtype=np.int16)
    is_object, meshes = classes != VOID, len(classes)
    boxes = np.zeros((views, meshes, 4), dtype=np.float32)
    visible = np.zeros((views, meshes), dtype=bool)
    pixels = np.zeros((views, meshes), dtype=np.int32)
    clear = np.zeros((views, meshes, 4), dtype=bool)
    void = 0
    for view, image in enumerate(images):
        counts = pixel_counts(image, meshes)
        void += int(counts[~is_object].sum())
        for k, found in enumerate(ndimage.find_objects(image, max_label=meshes)):
            if found is None or not is_object[k]:
                continue
            rows, columns = found
            if min(rows.stop - rows.start, columns.stop - columns.start) <= MIN_BOX_SIDE_PX:
                continue
            visible[view, k] = True
            pixels[view, k] = counts[k]
            boxes[view, k, ::2] = columns.start / width, columns.stop / width
            boxes[view, k, 1::2] = rows.start / height, rows.stop / height
            clear[view, k] = clear_sides(image, k + 1, rows, columns)
    tracked = np.flatnonzero(visible.any(axis=0))
    highest = len(tracked) + (void > 0)
    number = np.zeros(meshes + 1, dtype=np.uint8 if highest <= 255 else np.uint16)
    number[tracked + 1] = np.arange(1, len(tracked) + 1)
    number[1:][~is_object] = highest
    return Observations(
        tracked=tracked,
        unseen=np.setdiff1d(np.flatnonzero(is_object), tracked),
        object_class=classes[tracked],
        instance_ids=number[images],
        boxes=boxes[:, tracked],
        visible=visible[:, tracked],
        mask_pixels=pixels[:, tracked],
        sides_clear=clear[:, tracked],
    )


def clear_sides(
    image: np.ndarray, number: int, rows: slice, columns: slice
) -> tuple[bool, bool, bool, bool]:
    """True for each side of a mask's box that no other object touches.

    The sides are left, upper, right and lower; `number` is the mask's id in the image of ids.
    """
    top, left = max(rows.start - TOUCH_PX, 0), max(columns.start - TOUCH_PX, 0)
    around = image[top : rows.stop + TOUCH_PX, left : columns.stop + TOUCH_PX]
    mine = around == number
    other = (around != 0) & ~mine
    return (
        _clear(mine.T, other.T, columns.start - left, -1),
        _clear(mine, other, rows.start - top, -1),
        _clear(mine.T, other.T, columns.stop - 1 - left, 1),
        _clear(mine, other, rows.stop - 1 - top, 1),
    )


def _clear(mine: np.ndarray, other: np.ndarray, last: int, outwards: int) -> bool:
    """Test one side; `last` is the index of the mask's outermost row along the first axis."""
    if outwards < 0:
        rim, around = slice(last, last + 3), slice(max(last - TOUCH_PX, 0), last + 3)
    else:
        rim = slice(max(last - 2, 0), last + 1)
        around = slice(rim.start, rim.stop + TOUCH_PX)
    places = np.flatnonzero(mine[rim].any(axis=0))
    return not other[around, max(places[0] - TOUCH_PX, 0) : places[-1] + 1 + TOUCH_PX].any()
