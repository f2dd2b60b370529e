"""Arrays of a room in a view shard: their types and shapes, checked as they are read."""

from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprior.core.classes import STUFF

if TYPE_CHECKING:
    import h5py

_Side = int | str
VIEW_ARRAYS: dict[str, tuple[str, tuple[_Side, ...]]] = {
    "object_class": ("int16", ("n",)),
    "world_to_camera": ("float32", ("T", 4, 4)),
    "intrinsics": ("float32", ("T", 3, 3)),
    "boxes": ("float32", ("T", "n", 4)),
    "visible": ("bool", ("T", "n")),
    "mask_pixels": ("int32", ("T", "n")),
    "sides_clear": ("bool", ("T", "n", 4)),
}
"""Type and shape of each array of a room; T views, n objects, images of H x W pixels."""
IMAGES: dict[str, tuple[_Side, ...]] = {"instance_ids": ("T", "H", "W"), "stuff": ("T", "h", "w")}
"""Shape of each array of images; `stuff` is optional, and has its own size, h x w."""
TRUTH_ARRAYS: dict[str, tuple[str, tuple[_Side, ...]]] = {
    "object_class": ("int16", ("m",)),
    "centers_m": ("float32", ("m", 3)),
    "sizes_m": ("float32", ("m", 3)),
    "yaw_rad": ("float32", ("m",)),
    "model_to_room": ("float32", ("m", 4, 4)),
    "floor_m": ("float32", ("P", 2)),
}
UNOCCLUDED: dict[str, tuple[str, tuple[_Side, ...]]] = {"unoccluded": ("bool", ("T", "n"))}
"""Optional array, for rooms in which things without a mask may occlude objects."""
_MOST_DEFLATED = 1032
"""Maximum compression ratio of DEFLATE."""


def shape_of(sides: tuple[_Side, ...], sizes: dict[str, int]) -> tuple[_Side, ...]:
    return tuple(sizes.get(side, side) if isinstance(side, str) else side for side in sides)


def read_arrays(
    group: "h5py.Group",
    arrays: dict[str, tuple[str, tuple[_Side, ...]]],
    sizes: dict[str, int],
    classes: int,
) -> dict[str, np.ndarray]:
    """Read arrays of a view shard (such as `VIEW_ARRAYS`); the type and shape of each are checked
    before memory is allocated for it.

    Shapes name dimensions by letters, such as T for views. `sizes` maps these names to lengths;
    the lengths of names that it lacks are taken from the arrays, and added to it.
    """
    read: dict[str, np.ndarray] = {}
    for name, (dtype, sides) in arrays.items():
        stored = group[name]
        for side, length in zip(sides, stored.shape, strict=False):
            if isinstance(side, str):
                sizes.setdefault(side, length)
        shape = shape_of(sides, sizes)
        if stored.shape != shape:
            raise ValueError(f"{name} has shape {stored.shape}, expected {shape}")
        if stored.dtype != dtype:
            raise ValueError(f"{name} holds {stored.dtype}, expected {dtype}")
        _check_size(name, stored)
        read[name] = stored[()]
        if dtype == "float32" and not np.isfinite(read[name]).all():
            raise ValueError(f"{name} holds numbers that are not finite")
    if not ((read["object_class"] >= 0) & (read["object_class"] < classes)).all():
        raise ValueError(f"object_class is not below {classes}, the size of its label set")
    return read


def read_turn(group: "h5py.Group") -> dict[str, Any]:
    """Read the attributes of a room that was rotated by data preparation; empty for other rooms."""
    if "turned_deg" not in group.attrs:
        return {}
    degrees, matrix = float(group.attrs["turned_deg"]), group.attrs["room_from_world"]
    if matrix.shape != (4, 4) or not np.isfinite([degrees, *matrix.ravel()]).all():
        raise ValueError(f"turned_deg {degrees} and room_from_world {matrix.shape} are no turn")
    return {"turned_deg": degrees, "room_from_world": matrix}


def checked_images(group: "h5py.Group", name: str = "instance_ids") -> "h5py.Dataset":
    images = group[name]
    if images.dtype not in ("uint8", "uint16") or images.ndim != 3:
        raise ValueError(f"{name} is {images.dtype} {images.shape}, expected uint8 (T, H, W)")
    _check_size(name, images)
    return images


def _check_size(name: str, stored: "h5py.Dataset") -> None:
    """Reject an array whose shape needs more bytes than the file can store for it.

    A damaged shape may be huge.
    """
    if stored.nbytes > _MOST_DEFLATED * stored.id.get_storage_size():
        raise ValueError(f"{name} claims {stored.nbytes} bytes, more than are stored")


def known_ids(group: "h5py.Group", ids: np.ndarray) -> np.ndarray:
    objects = group["object_class"].shape[0]
    if (highest := int(ids.max(initial=0))) > objects + 1:
        raise ValueError(
            f"an instance id is {highest}, but it has {objects} objects, and {objects + 1} is void"
        )
    return ids


def known_stuff(group: "h5py.Group", stuff: np.ndarray) -> np.ndarray:
    if (highest := int(stuff.max(initial=0))) >= len(STUFF):
        raise ValueError(f"stuff is {highest}, expected below {len(STUFF)}")
    return stuff
