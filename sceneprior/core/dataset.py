"""Data sets that hold the rooms of one split in memory and make batches of their views."""

import copy
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int16, Int64
from torch import Tensor
from torch.utils.data import Dataset
from zlib_ng import zlib_ng

from sceneprior.core.boxes import turn_vectors
from sceneprior.core.errors import ShardError
from sceneprior.core.observations import RoomViews
from sceneprior.core.shards import Shard, iterate_rooms
from sceneprior.core.views import Batch, SceneViews

BLANK = -1
"""Epoch number that stands for padding: the room comes without objects."""
TURNS = ("", "@90", "@180", "@270")
"""Suffixes of the ids of rooms rotated about +y, by number of quarter turns."""
_OPEN_SHARDS = 32
_Room = TypeVar("_Room")


class MaskStore:
    """Instance-id images of a split, downsampled by `step`, read on first use and kept compressed.

    Images of ids consist of large uniform areas: a view of 480 x 360 pixels, downsampled by 4, has
    10,800 pixels and takes about 400 bytes compressed, so 100,000 views take 40 MB. Decompressing a
    view takes a twentieth of the time of reading it from the shard again.
    """

    def __init__(self, rooms: Sequence[tuple[Path, str]], step: int):
        self.rooms, self.step = tuple(rooms), step
        self._packed: dict[int, dict[int, bytes]] = {}
        self._forms: dict[int, tuple[tuple[int, ...], np.dtype]] = {}
        self._shards: OrderedDict[Path, Shard] = OrderedDict()

    def __getstate__(self) -> dict[str, Any]:
        # Open files cannot be pickled; each worker process opens its own.
        return {**self.__dict__, "_shards": OrderedDict()}

    def read(self, room: int, views: np.ndarray) -> np.ndarray:
        """Read images of a room: (views, H/step, W/step), 0 = background, k + 1 = object k."""
        packed = self._packed.setdefault(room, {})
        wanted = views.tolist()
        missing = sorted(set(wanted).difference(packed))
        if missing:
            path, room_id = self.rooms[room]
            shard = self._shards.pop(path, None) or Shard(path)
            self._shards[path] = shard  # the last used stands last
            if len(self._shards) > _OPEN_SHARDS:
                self._shards.popitem(last=False)[1].close()
            images = shard.read_instance_ids(room_id, missing, self.step)
            self._forms[room] = images.shape[1:], images.dtype
            for view, image in zip(missing, images, strict=True):
                # Level 6 would save another third of the memory but take twice the time.
                packed[view] = zlib_ng.compress(image, 3)
        shape, dtype = self._forms[room]
        plain = b"".join(zlib_ng.decompress(packed[view]) for view in wanted)
        return np.frombuffer(plain, dtype).reshape(-1, *shape)


class RoomDataset(Dataset):
    """Rooms of one split of a shard folder, in memory; a row is a room or its rotated copy.

    `rotations` is 1, or 4 to add a copy of each room rotated by 90, 180 and 270 degrees.
    """

    max_objects: int
    """Largest number of objects in a room."""
    counted: ClassVar[str]
    """Plural noun for the objects that `max_objects` counts, for messages."""
    masks: MaskStore | None = None
    """Images to read; if None, batches are made in the training process, on its device."""

    def __init__(self, rotations: int):
        self.rotations, self.label_set = rotations, ""
        self.plain_ids: list[str] = []

    def read_rooms(
        self, folder: Path, split: str, read: Callable[[Shard, str], _Room]
    ) -> list[_Room]:
        """Call `read` on each room of a split, and collect the results."""
        rooms = []
        for shard, room_id in iterate_rooms(folder, split):
            if self.label_set and shard.label_set != self.label_set:
                raise ShardError(
                    f"{shard.path} is labelled '{shard.label_set}' but its neighbours "
                    f"'{self.label_set}'; keep one label set per folder."
                )
            self.label_set = shard.label_set
            self.plain_ids.append(room_id)
            rooms.append(read(shard, room_id))
        if not rooms:
            raise ShardError(f"The shards of {folder}/{split} hold no rooms; prepare them again.")
        return rooms

    def __len__(self) -> int:
        return len(self.plain_ids) * self.rotations

    def for_validation(self) -> "RoomDataset":
        """The same rooms, in what training does not use of them, if anything."""
        return self

    @property
    def room_ids(self) -> tuple[str, ...]:
        """Ids of the rows: the room's id, with `@90` and so on for rotated copies."""
        turns = TURNS[: self.rotations]
        return tuple(room_id + turn for room_id in self.plain_ids for turn in turns)


@dataclass(frozen=True)
class FlatViews(Batch):
    """All views of a split as flat arrays, without the images.

    A sighting is a pair of a view and a tracked object of the same room, visible or not. Sightings
    are ordered by room, then view, then object. The last object and the last sighting are dummies,
    to which padding refers. A view takes 100 bytes, and a sighting 21.
    """

    object_count: Int[Tensor, " rooms"]
    first_object: Int[Tensor, " rooms"]
    first_view: Int[Tensor, " rooms"]
    first_sighting: Int[Tensor, " rooms"]
    object_class: Int16[Tensor, " objects"]
    world_to_camera: Float[Tensor, "views 4 4"]
    intrinsics: Float[Tensor, "views 3 3"]
    boxes: Float[Tensor, "sightings 4"]
    visible: Bool[Tensor, " sightings"]
    sides_clear: Bool[Tensor, "sightings 4"]

    @classmethod
    def of(cls, rooms: Sequence[RoomViews]) -> "FlatViews":
        """Concatenate the arrays of rooms."""
        views, objects = np.array([room.visible.shape for room in rooms]).T

        def joined(name: str, *shape: int) -> Tensor:
            parts = [getattr(room, name).reshape(-1, *shape) for room in rooms]
            if name in ("object_class", "boxes", "visible", "sides_clear"):
                parts.append(np.zeros((1, *shape), parts[0].dtype))
            return torch.from_numpy(np.concatenate(parts))

        def starts(counts: np.ndarray) -> Tensor:
            return torch.from_numpy(np.cumsum(counts) - counts)

        return cls(
            object_count=torch.from_numpy(objects),
            first_object=starts(objects),
            first_view=starts(views),
            first_sighting=starts(views * objects),
            object_class=joined("object_class"),
            world_to_camera=joined("world_to_camera", 4, 4),
            intrinsics=joined("intrinsics", 3, 3),
            boxes=joined("boxes", 4),
            visible=joined("visible"),
            sides_clear=joined("sides_clear", 4),
        )


def allowed_views(seed: int, room: int, count: int, fraction: float) -> Int64[np.ndarray, " views"]:
    """Indices of a room's views that training may use: a random share, determined by `seed`."""
    keep = max(1, round(fraction * count))
    order = np.random.default_rng([seed, room]).permutation(count)
    return np.sort(order[:keep])


class ViewDataset(RoomDataset):
    """Rooms of a split with their views; images are read only if masks are needed.

    Boxes and cameras of the whole split are in memory: tens of MB for 100,000 views. `to` moves
    them to a GPU, where batches are then made. Masks are read view by view.

    Args:
        views_per_room: Number of views sampled each time a room is drawn.
        view_fraction: Share of each room's views that may be sampled, chosen once by `seed`.
        mask_step: Downsampling step of the instance ids; None reads no images.
    """

    counted = "tracked objects"

    def __init__(
        self,
        folder: Path,
        split: str,
        views_per_room: int,
        rotations: int = 1,
        view_fraction: float = 1.0,
        mask_step: int | None = None,
        seed: int = 0,
    ):
        super().__init__(rotations)
        self.views_per_room, self.seed = views_per_room, seed
        places: list[tuple[Path, str]] = []

        def read(shard: Shard, room_id: str) -> RoomViews:
            places.append((shard.path, room_id))
            return shard.read_room(room_id)

        rooms = self.read_rooms(folder, split, read)
        self.flat = FlatViews.of(rooms)
        self.masks = None if mask_step is None else MaskStore(places, mask_step)
        self._image_sizes = tuple(room.image_size for room in rooms)
        self._object_counts = np.array([len(room.object_class) for room in rooms])
        self.max_objects = int(self._object_counts.max())
        self._view_counts = [len(room.visible) for room in rooms]
        self._allowed = [
            allowed_views(seed, index, len(room.visible), view_fraction)
            for index, room in enumerate(rooms)
        ]

    def for_validation(self) -> "ViewDataset":
        """The same rooms in the views that training does not use, if every room has some; else this
        data set."""
        others = copy.copy(self)
        others._allowed = [
            np.setdiff1d(np.arange(count), used)
            for count, used in zip(self._view_counts, self._allowed, strict=True)
        ]
        return others if all(map(len, others._allowed)) else self

    def to(self, device: torch.device | str) -> "ViewDataset":
        """Move boxes and cameras to `device`, where batches are then made."""
        self.flat = self.flat.to(device)
        return self

    def __getitems__(self, draws: list[tuple[int, int]]) -> SceneViews:
        """Make a batch from draws (row, epoch), which determine the sampled views.

        A draw of the epoch `BLANK` gives an empty room.
        """
        rows = np.array([row for row, _ in draws])
        rooms, quarters = np.divmod(rows, self.rotations)
        views = np.stack([self._draw(row, epoch) for row, epoch in draws])
        device = self.flat.boxes.device
        ids = None
        if self.masks is not None:
            images = [self.masks.read(int(r), v) for r, v in zip(rooms, views, strict=True)]
            stacked = np.stack(images)
            if stacked.dtype == np.uint16:  # torch cannot compare uint16
                stacked = stacked.astype(np.int32)
            ids = torch.from_numpy(stacked).to(device)
        flat, room, view = self.flat, *(torch.from_numpy(x).to(device) for x in (rooms, views))
        slot = torch.arange(int(self._object_counts[rooms].max()), device=device)
        count = flat.object_count[room][:, None]
        blank = torch.tensor([epoch == BLANK for _, epoch in draws], device=device)
        is_object = (slot < count) & ~blank[:, None]
        at_object = flat.first_object[room][:, None] + slot
        at_object = at_object.where(is_object, len(flat.object_class) - 1)
        at_sighting = (flat.first_sighting[room][:, None] + view * count)[:, :, None] + slot
        at_sighting = at_sighting.where(is_object[:, None], len(flat.visible) - 1)
        at_view = flat.first_view[room][:, None] + view
        # The cameras are rotated with the room, so the images stay the same.
        turn, shift = flat.world_to_camera[at_view].split([3, 1], dim=-1)
        turn = turn_vectors(turn, torch.from_numpy(quarters).to(device))
        return SceneViews(
            room_index=torch.from_numpy(rows).to(device),
            object_class=flat.object_class[at_object].long(),
            is_object=is_object,
            world_to_camera=torch.cat([turn, shift], dim=-1),
            intrinsics=flat.intrinsics[at_view],
            boxes=flat.boxes[at_sighting],
            visible=flat.visible[at_sighting],
            sides_clear=flat.sides_clear[at_sighting],
            image_size=self._image_sizes[rooms[0]],
            instance_ids=ids,
            mask_step=1 if self.masks is None else self.masks.step,
            room_ids=tuple(self.plain_ids[room] for room in rooms),
        )

    def _draw(self, row: int, epoch: int) -> np.ndarray:
        # A pure function of seed, row and epoch, so that resumed runs continue identically.
        allowed = self._allowed[row // self.rotations]
        generator = np.random.default_rng([self.seed, row, max(epoch, 0)])
        if len(allowed) >= self.views_per_room:
            return generator.choice(allowed, self.views_per_room, replace=False)
        # In a room with too few views, all are repeated about equally often.
        return np.resize(generator.permutation(allowed), self.views_per_room)
