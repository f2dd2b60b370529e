"""View shards: HDF5 files written by `shard_writing`, read by training (docs/shard_format.md)."""

import contextlib
import json
import operator
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel
from zlib_ng import zlib_ng

from sceneprior.core.checked import checked
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.errors import ShardError, shortened
from sceneprior.core.files import is_name, list_files, open_hdf5, read_json, reading
from sceneprior.core.observations import RoomGroundTruth, RoomViews, stuff_size, thinned

if TYPE_CHECKING:
    import h5py

FORMAT = "sceneprior-views"
VERSION = 2
READABLE = (1, VERSION)
"""Versions that can be read; in version 1, void pixels are 0, like the background."""
INDEX_NAME = "index.json"
PREPARE = "`sceneprior prep-front`, `prep-scannet`, `prep-posed` or `prep-dataset`"
"""Commands that write shards, for messages."""
_DAMAGED = f": the file is damaged. Delete it and run the same {PREPARE} command again."
MODELS_FOLDER = "models"
SPLITS = ("train", "val", "test")
"""Rooms for training, for choosing settings and checkpoints, and for reporting results."""
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


class Shard(contextlib.AbstractContextManager["Shard"]):
    """One shard, open for reading; close it, or use it in a `with` block."""

    def __init__(self, path: Path):
        self.path = Path(path)
        if not self.path.is_file():
            raise ShardError(f"No shard at {path}; {PREPARE} writes shards.")
        with reading(self.path, then=_DAMAGED, kind=ShardError):
            self._file = open_hdf5(self.path, whole=True)
            form = _decoded(self._file.attrs.get("format"))
            version = self._file.attrs.get("version")
            if form != FORMAT or version not in READABLE:
                self._file.close()
                raise ShardError(
                    f"{path} says format '{shortened(form, 60)}' version "
                    f"{shortened(version, 60)}, expected '{FORMAT}' version 1 "
                    f"or {VERSION}. Prepare the data again with this release's {PREPARE}."
                )
            self.label_set = _text(self._file.attrs, "label_set")
            self._classes = len(label_set(self.label_set))
            self._keys = {
                _text(group.attrs, "room_id"): key
                for key, group in self._file.get("rooms", {}).items()
            }

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
        with reading(self.path, f", room {room_id} cannot be read", _DAMAGED, ShardError):
            yield self._file["rooms"][self._keys[room_id]]

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


def _decoded(value: Any) -> Any:
    """Convert text as h5py reads it to `str`; leave other values unchanged."""
    return value.decode() if isinstance(value, bytes) else value


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


def splits_of(folder: Path) -> list[str]:
    """The splits that have shards; a folder made with `--only` has one."""
    return [split for split in SPLITS if list_files(Path(folder) / split, "*.h5")]


def list_shards(folder: Path, split: str) -> list[Path]:
    """List the shards of a split (`train`, `val` or `test`), sorted."""
    folder = Path(folder)
    if not folder.is_dir():
        raise ShardError(f"No folder of shards at {folder}; make one with {PREPARE}.")
    paths = list_files(folder / split, "*.h5")
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


class _Counts(BaseModel):
    rooms: int
    views: int
    objects: int


class _Index(BaseModel):
    """The contents of an `index.json`, as `prep-*` and `make-homes` write it last."""

    label_set: str
    source: str = ""
    counts: dict[str, _Counts] = {}


def read_index(folder: Path) -> dict[str, Any]:
    """Read a folder's `index.json`: label set, room type, counts and recipe."""
    path = Path(folder) / INDEX_NAME
    if not path.is_file():
        raise ShardError(
            f"{folder} has no {INDEX_NAME}; it is not a finished folder of shards. "
            f"Run {PREPARE} to its end."
        )
    index = read_json(path, hint=(hint := f"prepare {folder} again"))
    checked(_Index, index, str(path), hint)
    return index
