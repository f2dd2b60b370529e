"""View shards: HDF5 files written by `shard_writing`, read by training (docs/shard_format.md)."""

import contextlib
import json
import operator
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from zlib_ng import zlib_ng

from sceneprior.core.classes import label_set
from sceneprior.core.errors import ShardError
from sceneprior.core.files import is_name
from sceneprior.core.shard_arrays import (
    IMAGES,
    TRUTH_ARRAYS,
    UNOCCLUDED,
    VIEW_ARRAYS,
    checked_images,
    known_ids,
    known_stuff,
    read_arrays,
    read_turn,
    shape_of,
)

if TYPE_CHECKING:
    import h5py

FORMAT = "sceneprior-views"
VERSION = 2
READABLE = (1, VERSION)
"""Versions that can be read; in version 1, void pixels are 0, like the background."""
INDEX_NAME = "index.json"
PREPARE = "`sceneprior prep-front`, `prep-scannet`, `prep-posed` or `prep-dataset`"
"""Commands that write shards, for messages."""
MODELS_FOLDER = "models"
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


class Shard(contextlib.AbstractContextManager["Shard"]):
    """One shard, open for reading; close it, or use it in a `with` block."""

    def __init__(self, path: Path):
        self.path = Path(path)
        if not self.path.is_file():
            raise ShardError(f"No shard at {path}; {PREPARE} writes shards.")
        import h5py  # here, because loading a prior does not need it

        try:
            self._file = h5py.File(self.path, "r")
            form = _decoded(self._file.attrs.get("format"))
            version = self._file.attrs.get("version")
            if form != FORMAT or version not in READABLE:
                self._file.close()
                raise ShardError(
                    f"{path} says format '{_short(form)}' version {_short(version)}, expected "
                    f"'{FORMAT}' version 1 or {VERSION}. Prepare the data again with this "
                    f"release's {PREPARE}."
                )
            self.label_set = _text(self._file.attrs, "label_set")
            self._classes = len(label_set(self.label_set))
            self._keys = {
                _text(group.attrs, "room_id"): key
                for key, group in self._file.get("rooms", {}).items()
            }
        except ShardError:
            raise
        except Exception as error:  # the type that h5py raises depends on the damage
            raise _damaged(self.path, error) from None

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def room_ids(self) -> tuple[str, ...]:
        """Ids of the rooms in this shard, in their stored order."""
        return tuple(self._keys)

    @contextlib.contextmanager
    def _group(self, room_id: str) -> Iterator["h5py.Group"]:
        """Open a room's group; errors in the block are raised as damage of the shard."""
        try:
            yield self._file["rooms"][self._keys[room_id]]
        except ShardError:
            raise
        except Exception as error:
            raise _damaged(self.path, error, room_id) from None

    def read_room(self, room_id: str, images: bool = False) -> RoomViews:
        """Read the views of a room; `images` also reads the instance-id images."""
        with self._group(room_id) as group:
            height, width = (int(side) for side in group.attrs["image_size"])
            sizes = {"H": height, "W": width}
            arrays: dict[str, Any] = read_arrays(group, VIEW_ARRAYS, sizes, self._classes)
            sizes |= dict(zip("hw", stuff_size((height, width)), strict=True))
            read: dict[str, Any] = {"stuff": None}
            for name, check in (("instance_ids", known_ids), ("stuff", known_stuff)):
                if name == "stuff" and name not in group:
                    continue
                stored = checked_images(group, name)
                if stored.shape != (shape := shape_of(IMAGES[name], sizes)):
                    raise ValueError(f"{name} has shape {stored.shape}, expected {shape}")
                read[name] = check(group, stored[()]) if images else None
            arrays |= read_turn(group)
        return RoomViews(room_id=room_id, image_size=(height, width), **read, **arrays)

    def read_instance_ids(self, room_id: str, views: Sequence[int], step: int = 1) -> np.ndarray:
        """Read instance-id images of some views, downsampled: (views, H/step, W/step)."""
        with self._group(room_id) as group:
            images = checked_images(group)
            one_chunk_each = images.chunks == (1, *images.shape[1:]) and (
                (images.compression, images.shuffle, images.fletcher32) == ("gzip", False, False)
            )
            read = _inflate if one_chunk_each else operator.getitem
            return known_ids(group, np.stack([read(images, view)[thinned(step)] for view in views]))

    def has_ground_truth(self, room_id: str) -> bool:
        """Test whether a room has 3D ground truth; the user's posed pictures have none."""
        with self._group(room_id) as group:
            return "ground_truth" in group

    def has_stuff(self, room_id: str) -> bool:
        """Test whether a room has images of floor, walls and doors."""
        with self._group(room_id) as group:
            return "stuff" in group

    def read_checksum(self, room_id: str) -> str | None:
        """Read the `room_checksum` stored with a room; None in shards of earlier releases."""
        with self._group(room_id) as group:
            return _text(group.attrs, "sha256") if "sha256" in group.attrs else None

    def read_ground_truth(self, room_id: str) -> RoomGroundTruth:
        """Read the 3D ground truth of a room, for evaluation and baselines with 3D supervision."""
        with self._group(room_id) as group:
            if "ground_truth" not in group:
                raise ShardError(
                    f"{self.path}, room {room_id} carries no 3D ground truth, which this "
                    "evaluation compares with; posed pictures have none. Without it, `sceneprior "
                    "eval-fid` compares the observations in views (docs/posed_data.md)."
                )
            hidden = group["ground_truth"]
            known = TRUTH_ARRAYS | (UNOCCLUDED if "unoccluded" in hidden else {})
            arrays = read_arrays(hidden, known, {}, self._classes)
            model_ids = tuple(json.loads(_decoded(hidden.attrs["model_ids"])))
            if len(model_ids) != len(arrays["object_class"]):
                raise ValueError(f"it has {len(model_ids)} model_ids")
            for name in model_ids:
                if name and not is_name(name):
                    raise ValueError(f"{str(name)[:60]!r} names no model")
            height_m = float(hidden.attrs["height_m"])
            if not 0 < height_m < np.inf:
                raise ValueError(f"height_m is {height_m}")
            return RoomGroundTruth(model_ids=model_ids, height_m=height_m, **arrays)


def _decoded(value: Any) -> Any:
    """Convert text as h5py reads it to `str`; leave other values unchanged."""
    return value.decode() if isinstance(value, bytes) else value


def _short(value: Any) -> str:
    return " ".join(str(value).split())[:60]


def _text(attributes: Any, name: str) -> str:
    value = _decoded(attributes[name])
    if not isinstance(value, str) or not value.isprintable():
        raise ValueError(f"its {name} is not text")
    return value


def _inflate(images: "h5py.Dataset", view: int) -> np.ndarray:
    """Read and decompress the single chunk of an image, which is faster than h5py's selections."""
    size = images.dtype.itemsize * images.shape[1] * images.shape[2]
    at = range(len(images))[view]  # negative indices count from the end, as in h5py
    unfiltered, chunk = images.id.read_direct_chunk((at, 0, 0))
    if unfiltered:  # HDF5 may skip a filter that gains nothing
        return images[view]
    return np.frombuffer(zlib_ng.decompress(chunk, bufsize=size), images.dtype).reshape(
        images.shape[1:]
    )


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


def _damaged(path: Path, error: Exception, room_id: str = "") -> ShardError:
    where = f", room {room_id}" if room_id else ""
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    return ShardError(
        f"{path}{where} cannot be read ({reason}): the file is damaged. "
        f"Delete it and run the same {PREPARE} command again."
    )


def list_shards(folder: Path, split: str) -> list[Path]:
    """List the shards of a split (`train`, `val` or `test`), sorted."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ShardError(f"No folder of shards at {folder}; make one with {PREPARE}.")
    paths = sorted((folder / split).glob("*.h5"))
    if not paths:
        read_index(folder)  # a folder that is not one of shards has no index
        raise ShardError(
            f"The '{split}' split of {folder} holds no shards; prepare more rooms, or check the "
            f"split file given to {PREPARE}, and its report."
        )
    return paths


def iterate_rooms(folder: Path, split: str) -> Iterator[tuple[Shard, str]]:
    """Yield the rooms of a split as (open shard, room id), in a fixed order."""
    for path in list_shards(folder, split):
        with Shard(path) as shard:
            for room_id in shard.room_ids:
                yield shard, room_id


def read_index(folder: Path) -> dict[str, Any]:
    """Read a folder's `index.json`: label set, room type, counts and recipe."""
    path = Path(folder) / INDEX_NAME
    try:
        return json.loads(path.read_text())
    except OSError:
        raise ShardError(
            f"{folder} has no {INDEX_NAME}; it is not a finished folder of shards. "
            f"Run {PREPARE} to its end."
        ) from None
    except ValueError as error:
        raise ShardError(f"{path} is not JSON ({error}); prepare the folder again.") from None
