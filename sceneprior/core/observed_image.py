"""Instance masks of single images: read from shards and stacked into batches."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, Int64, Integer
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sceneprior.core.cameras import camera_centers
from sceneprior.core.errors import InputError
from sceneprior.core.shards import RoomViews, iterate_rooms, thinned
from sceneprior.core.views import SceneViews


@dataclass(frozen=True)
class ObservedImage:
    """Camera and instance masks of one image with n visible objects; arrays as in `RoomViews`."""

    name: str
    """Stem of the names of output files for this image."""
    label_set: str
    object_class: Int64[np.ndarray, " n"]
    instance_ids: Integer[np.ndarray, "height width"]
    boxes: Float32[np.ndarray, "n 4"]
    sides_clear: Bool[np.ndarray, "n 4"]
    world_to_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    room_id: str = ""
    view: int = 0
    rows: tuple[int, ...] = ()
    """Indices of the objects among the room's tracked objects; () if there is no room."""

    @property
    def eye_m(self) -> Float[np.ndarray, "3"]:
        """Camera centre in the room frame."""
        return camera_centers(self.world_to_camera)

    def sampled_ids(self, step: int) -> Integer[np.ndarray, "rows columns"]:
        """Instance ids downsampled by `step`, as in training (`thinned`)."""
        return self.instance_ids[thinned(step)]


def image_of_room(room: RoomViews, view: int, label_set: str) -> ObservedImage:
    """Extract one view of a room, with only the objects that are visible in it.

    `room` must have been read with its images.
    """
    if not 0 <= view < (count := len(room.visible)):
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
    number = np.zeros(len(room.object_class) + 2, dtype=np.int32)
    number[rows + 1] = np.arange(1, len(rows) + 1)
    number[-1] = len(rows) + 1  # void
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
    """Read one view of a room of the test or train split."""
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
    folder: Path, split: str, seed: int = 0, limit: int | None = None, views: int = 1
) -> tuple[list[ObservedImage], list[str]]:
    """Sample views of each room of a split from those that show an object.

    The sampled views of a room depend only on the seed and on the room's id. A larger `views` (the
    number of views per room) keeps these views and adds more.

    Returns:
        The images, and the ids of rooms left out because none of their views shows an object.
    """
    images: list[ObservedImage] = []
    blank: list[str] = []
    for shard, room_id in islice(iterate_rooms(folder, split), limit):
        useful = np.flatnonzero(shard.read_room(room_id).visible.any(axis=1))
        if not len(useful):
            blank.append(room_id)
            continue
        rng = np.random.default_rng([seed, *room_id.encode()])
        first = rng.choice(useful)
        drawn = [first, *rng.permutation(useful[useful != first])][:views]
        room = shard.read_room(room_id, images=True)
        images += [image_of_room(room, int(view), shard.label_set) for view in drawn]
    if not images:
        raise InputError(f"No view of the '{split}' rooms of {folder} shows an object.")
    return images, blank


def as_views(images: Sequence[ObservedImage], mask_step: int) -> SceneViews:
    """Stack images of one size into a batch: one room with one view each, padded to the largest
    object count."""
    sizes = sorted({image.instance_ids.shape for image in images})
    if len(sizes) > 1:
        raise InputError(
            f"Images that are fitted together must have one size, but these have {sizes[0]} and "
            f"{sizes[1]} pixels (height, width); reconstruct each size on its own."
        )

    def padded(rows: Sequence[np.ndarray]) -> Tensor:
        return pad_sequence([torch.from_numpy(row) for row in rows], batch_first=True)

    def stacked(matrices: Sequence[np.ndarray], dtype: type) -> Tensor:
        return torch.from_numpy(np.stack(matrices).astype(dtype)[:, None])

    is_object = padded([np.ones(len(image.object_class), bool) for image in images])
    return SceneViews(
        room_index=torch.arange(len(images)),
        object_class=padded([image.object_class for image in images]),
        is_object=is_object,
        world_to_camera=stacked([image.world_to_camera for image in images], np.float32),
        intrinsics=stacked([image.intrinsics for image in images], np.float32),
        boxes=padded([image.boxes for image in images])[:, None],
        visible=is_object[:, None],
        sides_clear=padded([image.sides_clear for image in images])[:, None],
        image_size=sizes[0],
        instance_ids=stacked([image.sampled_ids(mask_step) for image in images], np.int32),
        room_ids=tuple(image.name for image in images),
    )


def rows_of(
    views: SceneViews, rows: Integer[Tensor, " rows"] | Bool[Tensor, " rows"]
) -> SceneViews:
    """Select rooms of a batch, and trim the padding to the largest object count among them."""
    chosen = views.changed(lambda tensor: tensor[rows])
    most = max(int(chosen.is_object.sum(dim=-1).max()), 1)
    return replace(
        chosen,
        object_class=chosen.object_class[:, :most],
        is_object=chosen.is_object[:, :most],
        boxes=chosen.boxes[:, :, :most],
        visible=chosen.visible[:, :, :most],
        sides_clear=chosen.sides_clear[:, :, :most],
        room_ids=tuple(np.array(views.room_ids)[rows.numpy()]) if views.room_ids else (),
    )
