"""View shards: the HDF5 files in which preparing and learning meet (docs/shard_format.md)."""

import contextlib
import hashlib
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from zlib_ng import zlib_ng

from sceneprior.classes import label_set
from sceneprior.errors import ShardError

if TYPE_CHECKING:
    import h5py

FORMAT = "sceneprior-views"
VERSION = 1
INDEX_NAME = "index.json"
PREPARE = "`sceneprior prep-front`, `prep-scannet` or `prep-posed`"
"""What writes shards, for errors."""
MODELS_FOLDER = "models"


@dataclass(frozen=True)
class Sightings:
    """T views of n tracked objects, each seen in at least one of them, in H x W pixels."""

    object_class: np.ndarray
    """(n,) int16, index into the label set."""
    boxes: np.ndarray
    """(T, n, 4) float32: x1, y1, x2, y2 in [0, 1] of the visible mask; zeros where not visible."""
    visible: np.ndarray
    """(T, n) bool."""
    mask_pixels: np.ndarray
    """(T, n) int32, pixels of the visible mask."""
    sides_clear: np.ndarray
    """(T, n, 4) bool: no other object touches the mask at that side of its box, so the side is
    the object's own rather than an occluder's."""
    instance_ids: np.ndarray | None
    """(T, H, W) uint8 (uint16 past 255 objects), 0 = nothing, k + 1 = object k; None: not read."""


@dataclass(frozen=True)
class RoomViews(Sightings):
    """What cameras saw of one room: all that training may know."""

    room_id: str
    world_to_camera: np.ndarray
    """(T, 4, 4) float32, OpenCV axes, metres."""
    intrinsics: np.ndarray
    """(T, 3, 3) float32, pixels of the H x W image."""
    image_size: tuple[int, int]
    """(H, W)."""


@dataclass(frozen=True)
class RoomGroundTruth:
    """The room in 3D, for evaluation only. The first n of its m rows are the tracked objects."""

    object_class: np.ndarray
    """(m,) int16."""
    centers_m: np.ndarray
    """(m, 3) float32, centres of the axis-aligned boxes in the room frame."""
    sizes_m: np.ndarray
    """(m, 3) float32, their full extents."""
    yaw_rad: np.ndarray
    """(m,) float32, the piece's own turn about +y."""
    model_ids: tuple[str, ...]
    """(m,) names of the files `models/<id>.ply`; '' where the data set has no mesh."""
    model_to_room: np.ndarray
    """(m, 4, 4) float32, from the model's vertices to the room frame (scale, turn, place)."""
    floor_m: np.ndarray
    """(P, 2) float32, x and z along the floor's outline."""
    height_m: float
    """Floor to ceiling."""


_VIEW_ARRAYS = (
    "object_class", "world_to_camera", "intrinsics", "boxes", "visible", "mask_pixels",
    "sides_clear",
)  # fmt: skip
_TRUTH_ARRAYS = ("object_class", "centers_m", "sizes_m", "yaw_rad", "model_to_room", "floor_m")


def shard_bytes(
    name: str, label_set_name: str, rooms: Iterable[tuple[RoomViews, RoomGroundTruth | None]]
) -> bytes:
    """A shard as it would lie on disk; the same rooms give the same bytes. `rooms` may be a
    generator: one is held at a time.

    Built in memory, where a shard is a few MB: HDF5 does not recover from a disk that fills up.

    Raises:
        ShardError: a room's arrays disagree with each other; `name` is for the message.
    """
    import h5py

    with h5py.File(name, "w", driver="core", backing_store=False) as file:
        file.attrs["format"] = FORMAT
        file.attrs["version"] = VERSION
        file.attrs["label_set"] = label_set_name
        file.attrs["classes"] = json.dumps(label_set(label_set_name))
        for views, truth in rooms:
            check_views(name, views)
            # HDF5 reads "/" as a folder; ids such as <house>/<room> stay one name.
            key = views.room_id.replace("/", "|")
            _write_room(file.create_group(f"rooms/{key}"), views, truth)
        file.flush()
        return file.id.get_file_image()


def _write_room(group: "h5py.Group", views: RoomViews, truth: RoomGroundTruth | None) -> None:
    group.attrs["room_id"] = views.room_id
    group.attrs["image_size"] = views.image_size
    group.attrs["sha256"] = room_checksum(views, truth)
    for name in _VIEW_ARRAYS:
        group.create_dataset(name, data=getattr(views, name))
    ids = _images(views)
    # Level 8 halves what 4 leaves, for 1 ms a view; 9 takes 3 ms for the last 3%. More to
    # unpack is slower to read, too.
    group.create_dataset(
        "instance_ids", data=ids, chunks=(1, *ids.shape[1:]), compression="gzip",
        compression_opts=8, shuffle=False,
    )  # fmt: skip
    if truth is not None:
        hidden = group.create_group("ground_truth")
        for name in _TRUTH_ARRAYS:
            hidden.create_dataset(name, data=getattr(truth, name))
        hidden.attrs["model_ids"] = json.dumps(truth.model_ids)
        hidden.attrs["height_m"] = truth.height_m


def room_checksum(views: RoomViews, truth: RoomGroundTruth | None) -> str:
    """SHA-256 over all that a shard stores of a room; docs/shard_format.md spells it out."""
    size = [int(side) for side in views.image_size]
    parts: dict[str, Any] = {"room_id": views.room_id, "image_size": size}
    parts |= {name: getattr(views, name) for name in _VIEW_ARRAYS}
    parts["instance_ids"] = _images(views)
    if truth is not None:
        parts |= {f"ground_truth/{name}": getattr(truth, name) for name in _TRUTH_ARRAYS}
        parts |= {"model_ids": truth.model_ids, "height_m": float(truth.height_m)}
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
    """Compare the shapes of a room's arrays with each other, and its ids with its objects; the
    `ShardError` begins with `where`."""
    where = f"{where}, room {views.room_id}"
    count, objects = views.visible.shape
    expected = {
        "object_class": (objects,),
        "world_to_camera": (count, 4, 4),
        "intrinsics": (count, 3, 3),
        "boxes": (count, objects, 4),
        "mask_pixels": (count, objects),
        "sides_clear": (count, objects, 4),
        "instance_ids": (count, *views.image_size),
    }
    for name, shape in expected.items():
        came = getattr(getattr(views, name), "shape", None)
        if came != shape:
            raise ShardError(f"{where}: {name} has shape {came}, expected {shape}.")
    highest = int(_images(views).max(initial=0))
    if highest > objects:
        raise ShardError(
            f"{where}: an instance id is {highest}, but the room has {objects} objects."
        )


class Shard(contextlib.AbstractContextManager["Shard"]):
    """One shard, open for reading; close it or use it in a `with` block. A file that is missing,
    damaged or of another format is a `ShardError`."""

    def __init__(self, path: Path):
        self.path = Path(path)
        if not self.path.is_file():
            raise ShardError(f"No shard at {path}; {PREPARE} writes shards.")
        import h5py  # here, so that who loads a prior need not wait for it

        try:
            self._file = h5py.File(self.path, "r")
            form, version = self._file.attrs.get("format"), self._file.attrs.get("version")
            if form != FORMAT or version != VERSION:
                self._file.close()
                raise ShardError(
                    f"{path} says format '{form}' version {version}, expected '{FORMAT}' version "
                    f"{VERSION}. Prepare the data again with this release's {PREPARE}."
                )
            self.label_set = str(self._file.attrs["label_set"])
            self._keys = {
                str(group.attrs["room_id"]): key
                for key, group in self._file.get("rooms", {}).items()
            }
        except (OSError, KeyError, RuntimeError) as error:
            raise _damaged(self.path, error) from None

    def close(self) -> None:
        """Release the file."""
        self._file.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def room_ids(self) -> tuple[str, ...]:
        """Ids of the rooms in this shard, in the order they are stored."""
        return tuple(self._keys)

    @contextlib.contextmanager
    def _group(self, room_id: str) -> Iterator["h5py.Group"]:
        """A room's group; what cannot be read in it is told as damage."""
        try:
            yield self._file["rooms"][self._keys[room_id]]
        except (OSError, KeyError, RuntimeError, zlib_ng.error) as error:  # type: ignore[misc]
            raise _damaged(self.path, error, room_id) from None

    def read_room(self, room_id: str, images: bool = False) -> RoomViews:
        """What cameras saw of a room; `images` also reads every instance-id image."""
        with self._group(room_id) as group:
            arrays = {name: group[name][()] for name in _VIEW_ARRAYS}
            height, width = (int(side) for side in group.attrs["image_size"])
            ids = group["instance_ids"][()] if images else None
        return RoomViews(room_id=room_id, instance_ids=ids, image_size=(height, width), **arrays)

    def read_instance_ids(self, room_id: str, views: Sequence[int], step: int = 1) -> np.ndarray:
        """Instance-id images of some views, every `step`-th pixel: (views, H/step, W/step)."""
        with self._group(room_id) as group:
            images = group["instance_ids"]
            one_chunk_each = images.chunks == (1, *images.shape[1:]) and (
                (images.compression, images.shuffle, images.fletcher32) == ("gzip", False, False)
            )
            read = _inflate if one_chunk_each else _select
            return np.stack([read(images, view)[thinned(step)] for view in views])

    def has_ground_truth(self, room_id: str) -> bool:
        """Whether the room is known in 3D; the user's posed pictures have none."""
        with self._group(room_id) as group:
            return "ground_truth" in group

    def read_checksum(self, room_id: str) -> str | None:
        """What `room_checksum` said when the room was written; None in shards of before."""
        with self._group(room_id) as group:
            stored = group.attrs.get("sha256")
            return None if stored is None else str(stored)

    def read_ground_truth(self, room_id: str) -> RoomGroundTruth:
        """The room in 3D. For evaluation and baselines with 3D supervision."""
        with self._group(room_id) as group:
            if "ground_truth" not in group:
                raise ShardError(
                    f"{self.path}, room {room_id} carries no 3D ground truth, which this "
                    "evaluation compares with; posed pictures have none. Without it, `sceneprior "
                    "eval-fid` compares what views tell (docs/posed_data.md)."
                )
            hidden = group["ground_truth"]
            return RoomGroundTruth(
                model_ids=tuple(json.loads(hidden.attrs["model_ids"])),
                height_m=float(hidden.attrs["height_m"]),
                **{name: hidden[name][()] for name in _TRUTH_ARRAYS},
            )


def _select(images: "h5py.Dataset", view: int) -> np.ndarray:
    image: np.ndarray = images[view]
    return image


def _inflate(images: "h5py.Dataset", view: int) -> np.ndarray:
    """The same image, from its one deflated chunk: h5py's selections take longer than unpacking."""
    size = images.dtype.itemsize * images.shape[1] * images.shape[2]
    at = range(len(images))[view]  # as h5py reads it: from the end, or an IndexError
    unfiltered, chunk = images.id.read_direct_chunk((at, 0, 0))
    if unfiltered:  # HDF5 may leave out a filter that gains nothing
        return _select(images, view)
    return np.frombuffer(zlib_ng.decompress(chunk, bufsize=size), images.dtype).reshape(
        images.shape[1:]
    )


def thinned(step: int) -> tuple[slice, slice]:
    """Indexes every `step`-th pixel of an image (height, width), from the middle of a block, so
    that the small image is not shifted."""
    return (slice(step // 2, None, step),) * 2


def _damaged(path: Path, error: Exception, room_id: str = "") -> ShardError:
    where = f", room {room_id}" if room_id else ""
    return ShardError(
        f"{path}{where} cannot be read ({str(error).splitlines()[0]}): the file is damaged. "
        f"Delete it and run the same {PREPARE} command again."
    )


def list_shards(folder: Path, split: str) -> list[Path]:
    """The shards of a split (`train` or `test`), sorted; at least one, or a `ShardError`."""
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
    """Every room of a split with its open shard, in a fixed order."""
    for path in list_shards(folder, split):
        with Shard(path) as shard:
            for room_id in shard.room_ids:
                yield shard, room_id


def read_index(folder: Path) -> dict[str, Any]:
    """The folder's `index.json`: label set, room type, counts and the recipe that made it."""
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
