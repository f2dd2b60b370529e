"""Single images out of shards: a room and a view in, what one camera saw of it out."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Integer

from sceneprior.errors import InputError
from sceneprior.shards import RoomViews, Shard, iterate_rooms
from sceneprior.views import SceneViews


@dataclass(frozen=True)
class ObservedImage:
    """Instance masks of one image, of the n objects that it shows, and its camera."""

    name: str
    """What its files are called."""
    label_set: str
    object_class: Integer[np.ndarray, " n"]
    """Index into the label set."""
    instance_ids: Integer[np.ndarray, "height width"]
    """0 = nothing, k + 1 = object k."""
    boxes: Float[np.ndarray, "n 4"]
    """x1, y1, x2, y2 relative to the image size."""
    sides_clear: Bool[np.ndarray, "n 4"]
    """Which sides of a box are the object's own; see `SceneViews`."""
    world_to_camera: Float[np.ndarray, "4 4"]
    """To the camera from the room frame that the scene is told in."""
    intrinsics: Float[np.ndarray, "3 3"]
    room_id: str = ""
    view: int = 0
    rows: tuple[int, ...] = ()
    """Which of the room's tracked objects these are; () where there is no room."""


def image_of_room(room: RoomViews, view: int, label_set: str) -> ObservedImage:
    """One view of a room, read with its images; only what this view shows remains.

    Raises:
        InputError: the room has no such view, or the view shows no object.
    """
    count = len(room.visible)
    if not 0 <= view < count:
        raise InputError(
            f"Room {room.room_id} has no view {view}; its {count} views are 0 to {count - 1}."
        )
    rows = np.flatnonzero(room.visible[view])
    if not len(rows):
        raise InputError(
            f"View {view} of room {room.room_id} shows no object, so there is nothing to "
            "reconstruct from; choose a view that does (`sceneprior inspect` shows them)."
        )
    assert room.instance_ids is not None, "read_room(images=True)"
    number = np.zeros(len(room.object_class) + 1, dtype=room.instance_ids.dtype)
    number[rows + 1] = np.arange(1, len(rows) + 1)
    return ObservedImage(
        name=f"{room.room_id.replace('/', '_')}_view{view}",
        label_set=label_set,
        object_class=room.object_class[rows].astype(np.int64),
        instance_ids=number[room.instance_ids[view]],
        boxes=room.boxes[view, rows],
        sides_clear=room.sides_clear[view, rows],
        world_to_camera=room.world_to_camera[view],
        intrinsics=room.intrinsics[view],
        room_id=room.room_id,
        view=view,
        rows=tuple(rows.tolist()),
    )


def image_from_shards(folder: Path, room_id: str, view: int) -> ObservedImage:
    """One view of a room of either split.

    Raises:
        InputError: neither split holds the room, or see `image_of_room`.
        ShardError: a shard is missing or damaged.
    """
    found: list[str] = []
    for split in ("test", "train"):
        if not any((Path(folder) / split).glob("*.h5")):
            continue
        for shard, name in iterate_rooms(folder, split):
            if name == room_id:
                return image_of_room(shard.read_room(name, images=True), view, shard.label_set)
            found.append(name)
    raise InputError(
        f"{folder} holds no room '{room_id}'; it has {len(found)} rooms"
        + (f", such as {', '.join(found[:3])}." if found else ".")
    )


def images_of_split(
    folder: Path, split: str, seed: int = 0, limit: int | None = None
) -> tuple[list[ObservedImage], list[str]]:
    """One view of each room, drawn at random from the views that show an object.

    Args:
        folder: Shards.
        split: `train` or `test`.
        seed: Decides the view; another room more or less does not change it.
        limit: Only the first so many rooms.

    Returns:
        The images, and the ids of rooms of which no view shows anything: those are left out.

    Raises:
        ShardError: a shard is missing or damaged.
        InputError: no view of any room shows an object.
    """
    images: list[ObservedImage] = []
    blank: list[str] = []
    for number, (shard, room_id) in enumerate(iterate_rooms(folder, split)):
        if limit is not None and number >= limit:
            break
        useful = np.flatnonzero(shard.read_room(room_id).visible.any(axis=1))
        if not len(useful):
            blank.append(room_id)
            continue
        view = int(np.random.default_rng([seed, *room_id.encode()]).choice(useful))
        images.append(_read_one(shard, room_id, view))
    if not images:
        raise InputError(f"No view of the '{split}' rooms of {folder} shows an object.")
    return images, blank


def _read_one(shard: Shard, room_id: str, view: int) -> ObservedImage:
    return image_of_room(shard.read_room(room_id, images=True), view, shard.label_set)


def as_views(images: Sequence[ObservedImage], mask_step: int) -> SceneViews:
    """The images as a batch: each a room with one view, objects padded to the fullest image's.

    Args:
        images: At least one, all of one size.
        mask_step: Every how many pixels the instance ids are kept.

    Raises:
        InputError: the images differ in size.
    """
    sizes = sorted({image.instance_ids.shape for image in images})
    if len(sizes) > 1:
        raise InputError(
            f"Images that are fitted together have one size, but {sizes[0]} and {sizes[1]} pixels "
            "(height, width) came; reconstruct each size on its own."
        )
    height, width = sizes[0]
    most = max(len(image.object_class) for image in images)
    rooms = len(images)
    object_class = np.zeros((rooms, most), dtype=np.int64)
    is_object = np.zeros((rooms, most), dtype=bool)
    boxes = np.zeros((rooms, 1, most, 4), dtype=np.float32)
    clear = np.zeros((rooms, 1, most, 4), dtype=bool)
    for row, image in enumerate(images):
        count = len(image.object_class)
        object_class[row, :count] = image.object_class
        is_object[row, :count] = True
        boxes[row, 0, :count] = image.boxes
        clear[row, 0, :count] = image.sides_clear
    # In the middle of a block, as shards are sampled for training.
    part = slice(mask_step // 2, None, mask_step)
    ids = np.stack([image.instance_ids[part, part] for image in images])[:, None]
    return SceneViews(
        room_index=torch.arange(rooms),
        object_class=torch.from_numpy(object_class),
        is_object=torch.from_numpy(is_object),
        world_to_camera=_stacked([image.world_to_camera for image in images]),
        intrinsics=_stacked([image.intrinsics for image in images]),
        boxes=torch.from_numpy(boxes),
        visible=torch.from_numpy(is_object[:, None]),
        sides_clear=torch.from_numpy(clear),
        image_size=(height, width),
        instance_ids=torch.from_numpy(ids.astype(np.int32)),
        room_ids=tuple(image.name for image in images),
    )


def _stacked(matrices: Sequence[np.ndarray]) -> torch.Tensor:
    return torch.from_numpy(np.stack(matrices).astype(np.float32)[:, None])
