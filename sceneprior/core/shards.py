"""View shards: HDF5 files written by data preparation, read by training (docs/shard_format.md)."""

import contextlib
import hashlib
import json
import operator
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from zlib_ng import zlib_ng

from sceneprior.core.classes import label_set
from sceneprior.core.errors import ShardError
from sceneprior.core.files import is_name

if TYPE_CHECKING:
    import h5py

FORMAT = "sceneprior-views"
VERSION = 2
READABLE = (1, VERSION)
"""Versions that can be read; in version 1, void pixels are 0, like the background."""
INDEX_NAME = "index.json"
PREPARE = "`sceneprior prep-front`, `prep-scannet` or `prep-posed`"
"""Commands that write shards, for messages."""
MODELS_FOLDER = "models"


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
    """(T, n) int32, pixels of the visible mask."""
    sides_clear: np.ndarray
    """(T, n, 4) bool: no other object touches the mask at this side of its box, so the object
    itself ends there rather than being occluded."""
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


@dataclass(frozen=True)
class RoomGroundTruth:
    """3D ground truth of a room, for evaluation and baselines with 3D supervision.

    The first n of its m rows are the tracked objects.
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
    """(m, 4, 4) float32, transform from the model's frame to the room frame (with scale)."""
    floor_m: np.ndarray
    """(P, 2) float32, x and z along the floor's outline."""
    height_m: float
    """Height from floor to ceiling."""
    unoccluded: np.ndarray | None = None
    """(T, n) bool: a tracked object is fully inside the image and occluded by nothing in the room.
    None if only objects with masks can occlude, so that `sides_clear` suffices."""


_Side = int | str
_VIEW_ARRAYS: dict[str, tuple[str, tuple[_Side, ...]]] = {
    "object_class": ("int16", ("n",)),
    "world_to_camera": ("float32", ("T", 4, 4)),
    "intrinsics": ("float32", ("T", 3, 3)),
    "boxes": ("float32", ("T", "n", 4)),
    "visible": ("bool", ("T", "n")),
    "mask_pixels": ("int32", ("T", "n")),
    "sides_clear": ("bool", ("T", "n", 4)),
}
"""Type and shape of each array of a room; T views, n objects, images of H x W pixels."""
_IMAGES: tuple[_Side, ...] = ("T", "H", "W")
_TRUTH_ARRAYS: dict[str, tuple[str, tuple[_Side, ...]]] = {
    "object_class": ("int16", ("m",)),
    "centers_m": ("float32", ("m", 3)),
    "sizes_m": ("float32", ("m", 3)),
    "yaw_rad": ("float32", ("m",)),
    "model_to_room": ("float32", ("m", 4, 4)),
    "floor_m": ("float32", ("P", 2)),
}
_UNOCCLUDED: dict[str, tuple[str, tuple[_Side, ...]]] = {"unoccluded": ("bool", ("T", "n"))}
"""Optional array of rooms in which more than objects can occlude objects."""
_MOST_DEFLATED = 1032
"""Maximum compression ratio of DEFLATE."""


def shard_bytes(
    name: str, label_set_name: str, rooms: Iterable[tuple[RoomViews, RoomGroundTruth | None]]
) -> bytes:
    """Encode rooms as the bytes of a shard; the same rooms give the same bytes.

    The shard, a few MB, is built in memory because HDF5 does not recover from a full disk. From a
    generator, one room is held in memory at a time. `name` is for messages.
    """
    import h5py

    with h5py.File(name, "w", driver="core", backing_store=False) as file:
        file.attrs["version"] = VERSION
        _write_text(file, "format", FORMAT)
        _write_text(file, "label_set", label_set_name)
        _write_text(file, "classes", json.dumps(label_set(label_set_name)))
        for views, truth in rooms:
            check_views(name, views)
            # HDF5 treats "/" as a group separator, and ids such as <house>/<room> contain it.
            key = views.room_id.replace("/", "|")
            _write_room(file.create_group(f"rooms/{key}"), views, truth)
        file.flush()
        return file.id.get_file_image()


def _write_room(group: "h5py.Group", views: RoomViews, truth: RoomGroundTruth | None) -> None:
    _write_text(group, "room_id", views.room_id)
    group.attrs["image_size"] = views.image_size
    _write_text(group, "sha256", room_checksum(views, truth))
    for name in _VIEW_ARRAYS:
        group.create_dataset(name, data=getattr(views, name))
    ids = _images(views)
    # Level 8 gives half the size of level 4 and takes 1 ms a view; level 9 takes 3 ms for the last
    # 3%. Larger data is slower to read, too.
    group.create_dataset(
        "instance_ids", data=ids, chunks=(1, *ids.shape[1:]), compression="gzip",
        compression_opts=8, shuffle=False,
    )  # fmt: skip
    if truth is not None:
        hidden = group.create_group("ground_truth")
        for name in _TRUTH_ARRAYS:
            hidden.create_dataset(name, data=getattr(truth, name))
        if truth.unoccluded is not None:
            hidden.create_dataset("unoccluded", data=truth.unoccluded)
        _write_text(hidden, "model_ids", json.dumps(truth.model_ids))
        hidden.attrs["height_m"] = truth.height_m


def _write_text(group: "h5py.Group", name: str, text: str) -> None:
    """Write a text as an attribute of fixed length, or of variable length if it is too long.

    HDF5 keeps texts of variable length in a heap, and a single damaged byte there can make it read
    forever.
    """
    import h5py

    data = text.encode()
    length = len(data) if 0 < len(data) < 2**15 else None
    group.attrs.create(name, data, dtype=h5py.string_dtype("utf-8", length))


def room_checksum(views: RoomViews, truth: RoomGroundTruth | None) -> str:
    """SHA-256 of all data of a room in a shard, as specified in docs/shard_format.md."""
    size = [int(side) for side in views.image_size]
    parts: dict[str, Any] = {"room_id": views.room_id, "image_size": size}
    parts |= {name: getattr(views, name) for name in _VIEW_ARRAYS}
    parts["instance_ids"] = _images(views)
    if truth is not None:
        parts |= {f"ground_truth/{name}": getattr(truth, name) for name in _TRUTH_ARRAYS}
        parts |= {"model_ids": truth.model_ids, "height_m": float(truth.height_m)}
        if truth.unoccluded is not None:
            parts["ground_truth/unoccluded"] = truth.unoccluded
    summary = hashlib.sha256()
    for name, value in parts.items():
        if isinstance(value, np.ndarray):
            summary.update(f"{name} {value.dtype.str} {value.shape}\n".encode())
            summary.update(np.ascontiguousarray(value).data)
        else:
            summary.update(f"{name} {json.dumps(value)}\n".encode())
    return summary.hexdigest()


def _images(views: RoomViews) -> np.ndarray:
    if views.instance_ids is None:
        raise ShardError(
            f"Room {views.room_id} was read without its images; read them to write it."
        )
    return views.instance_ids


def check_views(where: str, views: RoomViews) -> None:
    """Check that the arrays of a room have consistent shapes and valid ids; `where` begins the
    message."""
    where = f"{where}, room {views.room_id}"
    count, objects = views.visible.shape
    height, width = views.image_size
    sizes = {"T": count, "n": objects, "H": height, "W": width}
    shapes = {name: shape for name, (_, shape) in _VIEW_ARRAYS.items()} | {"instance_ids": _IMAGES}
    for name, sides in shapes.items():
        came, shape = getattr(getattr(views, name), "shape", None), _shape(sides, sizes)
        if came != shape:
            raise ShardError(f"{where}: {name} has shape {came}, expected {shape}.")
    highest = int(_images(views).max(initial=0))
    if highest > objects + 1:
        raise ShardError(
            f"{where}: an instance id is {highest}, but the room has {objects} objects, and "
            f"{objects + 1} is void."
        )


def _shape(sides: tuple[_Side, ...], sizes: dict[str, int]) -> tuple[_Side, ...]:
    return tuple(sizes.get(side, side) if isinstance(side, str) else side for side in sides)


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
            arrays = _read_arrays(group, _VIEW_ARRAYS, sizes, self._classes)
            stored = _checked_images(group)
            if stored.shape != (shape := _shape(_IMAGES, sizes)):
                raise ValueError(f"instance_ids has shape {stored.shape}, expected {shape}")
            ids = _known_ids(group, stored[()]) if images else None
        return RoomViews(room_id=room_id, instance_ids=ids, image_size=(height, width), **arrays)

    def read_instance_ids(self, room_id: str, views: Sequence[int], step: int = 1) -> np.ndarray:
        """Read instance-id images of some views, downsampled: (views, H/step, W/step)."""
        with self._group(room_id) as group:
            images = _checked_images(group)
            one_chunk_each = images.chunks == (1, *images.shape[1:]) and (
                (images.compression, images.shuffle, images.fletcher32) == ("gzip", False, False)
            )
            read = _inflate if one_chunk_each else operator.getitem
            return _known_ids(
                group, np.stack([read(images, view)[thinned(step)] for view in views])
            )

    def has_ground_truth(self, room_id: str) -> bool:
        """Test whether a room has 3D ground truth; the user's posed pictures have none."""
        with self._group(room_id) as group:
            return "ground_truth" in group

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
                    "eval-fid` compares what views tell (docs/posed_data.md)."
                )
            hidden = group["ground_truth"]
            known = _TRUTH_ARRAYS | (_UNOCCLUDED if "unoccluded" in hidden else {})
            arrays = _read_arrays(hidden, known, {}, self._classes)
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
        raise ValueError(f"its {name} is no text")
    return value


def _read_arrays(
    group: "h5py.Group",
    arrays: dict[str, tuple[str, tuple[_Side, ...]]],
    sizes: dict[str, int],
    classes: int,
) -> dict[str, np.ndarray]:
    """Read arrays of the format; each is checked before memory is allocated for it.

    `sizes` holds the known lengths of named sides; lengths found here are added.
    """
    read: dict[str, np.ndarray] = {}
    for name, (dtype, sides) in arrays.items():
        stored = group[name]
        for side, length in zip(sides, stored.shape, strict=False):
            if isinstance(side, str):
                sizes.setdefault(side, length)
        shape = _shape(sides, sizes)
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


def _checked_images(group: "h5py.Group") -> "h5py.Dataset":
    images = group["instance_ids"]
    if images.dtype not in ("uint8", "uint16") or images.ndim != 3:
        raise ValueError(f"instance_ids is {images.dtype} {images.shape}, expected uint8 (T, H, W)")
    _check_size("instance_ids", images)
    return images


def _check_size(name: str, stored: "h5py.Dataset") -> None:
    """Reject a data set that claims more bytes than it can hold; a damaged shape may be huge."""
    if stored.nbytes > _MOST_DEFLATED * stored.id.get_storage_size():
        raise ValueError(f"{name} claims {stored.nbytes} bytes, more than are stored")


def _known_ids(group: "h5py.Group", ids: np.ndarray) -> np.ndarray:
    objects = group["object_class"].shape[0]
    if (highest := int(ids.max(initial=0))) > objects + 1:
        raise ValueError(
            f"an instance id is {highest}, but it has {objects} objects, and {objects + 1} is void"
        )
    return ids


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
