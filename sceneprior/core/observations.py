"""Views of rooms: their images of instance ids, and the 2D boxes and visibility of objects in them.

The 3D ground truth of a room stands beside its views."""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from sceneprior.core.classes import VOID

MIN_BOX_SIDE_PX = 4
"""Limit on the sides of a mask's box, in pixels: an object counts as visible in a view if both
sides are longer."""

TOUCH_PX = 4
"""Distance in pixels within which another object counts as touching a side of a mask, so that it
may occlude the masked object."""

STUFF_SIDE_PX = 240
"""Approximate longer side of images of stuff. Their outlines are straight, so that many pixels
measure the same line."""


@dataclass(frozen=True)
class Sightings:
    """Observations of n tracked objects in T views of H x W pixels; each object is visible in at
    least one view."""

    object_class: np.ndarray
    """(n,) int16, index into the label set."""
    boxes: np.ndarray
    """(T, n, 4) float32: x1, y1, x2, y2 of the visible mask in [0, 1]; zeros if not visible."""
    visible: np.ndarray
    """(T, n) bool."""
    mask_pixels: np.ndarray
    """(T, n) int32, number of pixels of each object's visible mask."""
    sides_clear: np.ndarray
    """(T, n, 4) bool: True if no other object touches the mask at this side of its box, so that the
    object ends there and is not occluded."""
    instance_ids: np.ndarray | None
    """(T, H, W) uint8 (uint16 if an id is above 255): 0 = background, k + 1 = object k, n + 1 =
    void, which may occlude objects; None if the images were not read."""


@dataclass(frozen=True)
class RoomViews(Sightings):
    """Views of one room: the 2D observations that training may use."""

    room_id: str
    world_to_camera: np.ndarray
    """(T, 4, 4) float32, OpenCV axes, metres."""
    intrinsics: np.ndarray
    """(T, 3, 3) float32, in pixels of the H x W image."""
    image_size: tuple[int, int]
    """(H, W)."""
    stuff: np.ndarray | None = None
    """(T, h, w) uint8, index into `STUFF`: floor, walls, doors, windows and ceiling, thinned by
    `stuff_step`; 0 for objects, other surfaces and unknown pixels. None if the source does not name
    them, or if the images were not read."""
    turned_deg: float = 0.0
    """Angle about +y by which data preparation rotated the room, so that its walls run along x and
    z."""
    room_from_world: np.ndarray | None = None
    """(4, 4) float64 rigid transform from the source's world, in metres; None for other rooms."""


@dataclass(frozen=True)
class RoomGroundTruth:
    """3D ground truth of a room, for evaluation and baselines with 3D supervision.

    Arrays with m rows have one row per object: the n tracked objects in their order, then those
    that no view shows.
    """

    object_class: np.ndarray
    """(m,) int16."""
    centers_m: np.ndarray
    """(m, 3) float32, centres of the axis-aligned boxes in the room frame."""
    sizes_m: np.ndarray
    """(m, 3) float32, full extents of these boxes."""
    yaw_rad: np.ndarray
    """(m,) float32, rotation of the piece about +y."""
    model_ids: tuple[str, ...]
    """(m,) names of the files `models/<id>.ply`; '' if the data set has no mesh."""
    model_to_room: np.ndarray
    """(m, 4, 4) float32, transform from the model's frame to the room frame, including scale."""
    floor_m: np.ndarray
    """(P, 2) float32, x and z along the floor's outline."""
    height_m: float
    """Height from floor to ceiling."""
    unoccluded: np.ndarray | None = None
    """(T, n) bool: True if the tracked object is fully inside the image and nothing in the room
    occludes it. None if only objects with masks can occlude others, so that `sides_clear`
    suffices."""


def thinned(step: int) -> tuple[slice, slice]:
    """Slices that downsample an image (height, width) by `step`.

    They take the middle pixel of each block, so that the small image is not shifted.
    """
    return (slice(step // 2, None, step),) * 2


def thinned_intrinsics(intrinsics: np.ndarray, step: int) -> np.ndarray:
    """Intrinsics, (..., 3, 3), in pixels of images that were downsampled by `thinned`."""
    found = np.array(intrinsics, dtype=np.float64)
    found[..., :2, 2] += step / 2 - step // 2 - 0.5
    found[..., :2, :] /= step
    return found


def stuff_step(image_size: tuple[int, int]) -> int:
    """Step of `thinned` for images of stuff; their longer side is then about `STUFF_SIDE_PX`."""
    return max(1, round(max(image_size) / STUFF_SIDE_PX))


def thinned_stuff(images: np.ndarray) -> np.ndarray:
    """The pixels of images, (..., H, W), at which stuff is kept."""
    return images[(..., *thinned(stuff_step(images.shape[-2:])))]


def stuff_size(image_size: tuple[int, int]) -> tuple[int, int]:
    """Size, (h, w), of images of stuff."""
    step = stuff_step(image_size)
    height, width = (len(range(step // 2, side, step)) for side in image_size)
    return height, width


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
    from scipy import ndimage  # imported here: reading shards does not need it

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
