"""Writes and checks the rooms of a view shard (docs/shard_format.md)."""

import hashlib
import json
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprior.core.classes import label_set
from sceneprior.core.errors import ShardError
from sceneprior.core.observations import RoomGroundTruth, RoomViews, stuff_size
from sceneprior.core.shards import FORMAT, IMAGES, TRUTH_ARRAYS, VERSION, VIEW_ARRAYS, shape_of

if TYPE_CHECKING:
    import h5py


def shard_bytes(
    name: str, label_set_name: str, rooms: Iterable[tuple[RoomViews, RoomGroundTruth | None]]
) -> bytes:
    """Encode rooms as the bytes of a shard; the same rooms give the same bytes.

    The shard, a few MB, is built in memory because HDF5 does not recover from a full disk. If
    `rooms` is a generator, only one room is held in memory at a time. `name` appears in messages.
    """
    import h5py

    with h5py.File(name, "w", driver="core", backing_store=False) as file:
        file.attrs["version"] = VERSION
        _write_text(file, "format", FORMAT)
        _write_text(file, "label_set", label_set_name)
        _write_text(file, "classes", json.dumps(label_set(label_set_name)))
        for views, truth in rooms:
            # HDF5 treats "/" as a group separator, and ids such as <house>/<room> contain it.
            key = views.room_id.replace("/", "|")
            _write_room(file.create_group(f"rooms/{key}"), views, truth)
        file.flush()
        return file.id.get_file_image()


def _write_room(group: "h5py.Group", views: RoomViews, truth: RoomGroundTruth | None) -> None:
    _write_text(group, "room_id", views.room_id)
    group.attrs["image_size"] = views.image_size
    if views.turned_deg:
        group.attrs["turned_deg"] = views.turned_deg
        group.attrs["room_from_world"] = views.room_from_world
    _write_text(group, "sha256", room_checksum(views, truth))
    for name in VIEW_ARRAYS:
        group.create_dataset(name, data=getattr(views, name))
    # Level 8 gives half the size of level 4 and takes 1 ms a view; level 9 takes 3 ms for the last
    # 3%. Larger data is slower to read, too.
    for name, images in _images(views).items():
        group.create_dataset(
            name, data=images, chunks=(1, *images.shape[1:]), compression="gzip",
            compression_opts=8, shuffle=False,
        )  # fmt: skip
    if truth is not None:
        hidden = group.create_group("ground_truth")
        for name in TRUTH_ARRAYS:
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
    parts |= {name: getattr(views, name) for name in VIEW_ARRAYS}
    parts |= _images(views)
    if views.turned_deg:
        parts |= {"turned_deg": views.turned_deg, "room_from_world": views.room_from_world}
    if truth is not None:
        parts |= {f"ground_truth/{name}": getattr(truth, name) for name in TRUTH_ARRAYS}
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


def _images(views: RoomViews) -> dict[str, np.ndarray]:
    if views.instance_ids is None:
        raise ShardError(
            f"Room {views.room_id} was read without its images; read them to write it."
        )
    images = {"instance_ids": views.instance_ids}
    return images if views.stuff is None else images | {"stuff": views.stuff}


def check_room(where: str, views: RoomViews, truth: RoomGroundTruth | None) -> None:
    """Check that the arrays of a room have consistent shapes, valid ids and finite numbers.

    `where` is the beginning of an error's message.
    """
    where = f"{where}, room {views.room_id}"
    count, objects = views.visible.shape
    height, width = views.image_size
    sizes = {"T": count, "n": objects, "H": height, "W": width}
    sizes |= dict(zip("hw", stuff_size(views.image_size), strict=True))
    shapes = {name: shape for name, (_, shape) in VIEW_ARRAYS.items()} | IMAGES
    if views.stuff is None:
        del shapes["stuff"]
    for name, sides in shapes.items():
        came, shape = getattr(getattr(views, name), "shape", None), shape_of(sides, sizes)
        if came != shape:
            raise ShardError(f"{where}: {name} has shape {came}, expected {shape}.")
    floats = {name: getattr(views, name) for name in VIEW_ARRAYS}
    if truth is not None:
        floats |= {name: getattr(truth, name) for name in TRUTH_ARRAYS}
        floats["height_m"] = np.array(truth.height_m)
    for name, values in floats.items():
        if not np.isfinite(values).all():
            raise ShardError(f"{where}: {name} holds numbers that are not finite.")
    highest = int(_images(views)["instance_ids"].max(initial=0))
    if highest > objects + 1:
        raise ShardError(
            f"{where}: an instance id is {highest}, but the room has {objects} objects, and "
            f"{objects + 1} is void."
        )
