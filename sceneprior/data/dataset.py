"""The rooms of one split of a shard folder, in memory, and batches of their views."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from itertools import islice
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int16, Int64
from torch import Tensor
from torch.utils.data import Dataset

from sceneprior.data.masks import MaskStore
from sceneprior.errors import ShardError
from sceneprior.geometry.turns import turn_vectors
from sceneprior.shards import RoomViews, Shard, iterate_rooms
from sceneprior.views import SceneViews

BLANK = -1
"""An epoch no one draws in: the room comes without objects, and teaches nothing."""
TURNS = ("", "@90", "@180", "@270")
"""What marks the id of a room that was turned about +y by so many quarters."""
_Room = TypeVar("_Room")


class RoomDataset(Dataset):
    """Rooms of a split of a shard folder, in memory; each row is a room or a turned copy of one.

    `rotations` is 1, or 4 to add each room turned by 90, 180 and 270 degrees.
    """

    max_objects: int
    """Objects of the fullest room."""
    counted: ClassVar[str]
    """What `max_objects` counts, in words."""
    masks: MaskStore | None = None
    """Images to be read; None: batches are made in the training process, on its device."""

    def __init__(self, rotations: int):
        self.rotations, self.label_set = rotations, ""
        self.plain_ids: list[str] = []

    def read_rooms(
        self,
        folder: Path,
        split: str,
        read: Callable[[Shard, str], _Room],
        limit: int | None = None,
    ) -> list[_Room]:
        """What `read` says of each room of a split, or of the first `limit`.

        Raises:
            ShardError: a shard is missing, damaged, or of another label set than the first.
        """
        rooms = []
        for shard, room_id in islice(iterate_rooms(folder, split), limit):
            if self.label_set and shard.label_set != self.label_set:
                raise ShardError(
                    f"{shard.path} is labelled '{shard.label_set}' but its neighbours "
                    f"'{self.label_set}'; keep one label set a folder."
                )
            self.label_set = shard.label_set
            self.plain_ids.append(room_id)
            rooms.append(read(shard, room_id))
        if not rooms:
            raise ShardError(f"The shards of {folder}/{split} hold no rooms; prepare them again.")
        return rooms

    def __len__(self) -> int:
        return len(self.plain_ids) * self.rotations

    @property
    def room_ids(self) -> tuple[str, ...]:
        """One id a row: the room's, with `@90` and so on for its turned copies."""
        turns = TURNS[: self.rotations]
        return tuple(room_id + turn for room_id in self.plain_ids for turn in turns)


@dataclass(frozen=True)
class FlatViews:
    """What cameras saw of a whole split, without the images: 100 bytes a view, 21 a sighting.

    A sighting is a tracked object in a view of its room, visible or not. Rooms follow each other;
    within a room, views do; within a view, objects. The last object and the last sighting are
    nothing at all: padding points at them.
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
        """Lay the rooms' arrays end to end."""
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

    @property
    def bytes(self) -> int:
        """Memory of all tensors together."""
        return sum(getattr(self, item.name).nbytes for item in fields(self))

    def to(self, device: torch.device | str) -> "FlatViews":
        """The same on `device`."""
        return FlatViews(
            **{item.name: getattr(self, item.name).to(device) for item in fields(self)}
        )

    def gather(
        self,
        room: Int[Tensor, " batch"],
        view: Int[Tensor, "batch views"],
        quarter: Int[Tensor, " batch"],
        objects: int,
        blank: Bool[Tensor, " batch"] | None = None,
    ) -> dict[str, Any]:
        """Some views of some rooms, as fields of `SceneViews`.

        Views are counted within their room, which is turned about +y by a number of quarters.
        Rooms are padded to `objects`; `blank` ones are shown without any.
        """
        slot = torch.arange(objects, device=self.boxes.device)
        count = self.object_count[room][:, None]
        is_object = slot < count
        if blank is not None:
            is_object = is_object & ~blank[:, None]
        at_object = self.first_object[room][:, None] + slot
        at_object = at_object.where(is_object, len(self.object_class) - 1)
        at_sighting = (self.first_sighting[room][:, None] + view * count)[:, :, None] + slot
        at_sighting = at_sighting.where(is_object[:, None], len(self.visible) - 1)
        at_view = self.first_view[room][:, None] + view
        poses = self.world_to_camera[at_view]
        return {
            "object_class": self.object_class[at_object].long(),
            "is_object": is_object,
            # A camera sees the turned room as it saw the plain one.
            "world_to_camera": torch.cat(
                [turn_vectors(poses[..., :3], quarter), poses[..., 3:]], dim=-1
            ),
            "intrinsics": self.intrinsics[at_view],
            "boxes": self.boxes[at_sighting],
            "visible": self.visible[at_sighting],
            "sides_clear": self.sides_clear[at_sighting],
        }


def allowed_views(
    seed: int, room: int, count: int, fraction: float, held_out: bool = False
) -> Int64[np.ndarray, " views"]:
    """Which of a room's `count` views training may use: a share of them, chosen by the seed; or the
    others, which it may not."""
    keep = max(1, round(fraction * count))
    order = np.random.default_rng([seed, room]).permutation(count)
    return np.sort(order[keep:] if held_out else order[:keep])


class ViewDataset(RoomDataset):
    """Rooms of a split with their views; images are read only where masks are wanted.

    Boxes and cameras of the whole split are in memory, flat: tens of MB for 100,000 views. `to`
    moves them to a GPU, and batches are made there. Masks are read view by view.

    Args:
        folder, split, rotations, limit: See `RoomDataset`.
        views_per_room: Views drawn each time a room is asked for, by `seed`.
        view_fraction: Share of each room's views that may be drawn, chosen once by `seed`.
        held_out: The other views are drawn instead, those of which training sees nothing; every
            room must have some.
        mask_step: Every how many pixels the instance ids are kept; None reads no images.
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
        limit: int | None = None,
        held_out: bool = False,
    ):
        super().__init__(rotations)
        self.views_per_room, self.seed = views_per_room, seed
        places: list[tuple[Path, str]] = []

        def read(shard: Shard, room_id: str) -> RoomViews:
            places.append((shard.path, room_id))
            return shard.read_room(room_id)

        rooms = self.read_rooms(folder, split, read, limit)
        self.flat = FlatViews.of(rooms)
        self.masks = None if mask_step is None else MaskStore(places, mask_step)
        self._image_sizes = tuple(room.image_size for room in rooms)
        self._object_counts = np.array([len(room.object_class) for room in rooms])
        self.max_objects = int(self._object_counts.max())
        self._allowed = [
            allowed_views(seed, index, len(room.visible), view_fraction, held_out)
            for index, room in enumerate(rooms)
        ]

    def to(self, device: torch.device | str) -> "ViewDataset":
        """Move boxes and cameras to `device`, where batches are then made."""
        self.flat = self.flat.to(device)
        return self

    def __getitems__(self, draws: list[tuple[int, int]]) -> SceneViews:
        """A batch of rows; each draw is (row, epoch), which together decide its views.

        The views of an epoch `BLANK` show nothing of a room in which there is nothing.
        """
        rows = np.array([row for row, _ in draws])
        rooms, quarters = np.divmod(rows, self.rotations)
        views = np.stack([self._draw(row, epoch) for row, epoch in draws])
        device = self.flat.boxes.device
        ids = None
        if self.masks is not None:
            images = [self.masks.read(int(r), v) for r, v in zip(rooms, views, strict=True)]
            ids = torch.from_numpy(np.stack(images)).to(device)
        return SceneViews(
            room_index=torch.from_numpy(rows).to(device),
            **self.flat.gather(
                torch.from_numpy(rooms).to(device),
                torch.from_numpy(views).to(device),
                torch.from_numpy(quarters).to(device),
                int(self._object_counts[rooms].max()),
                torch.tensor([epoch == BLANK for _, epoch in draws], device=device),
            ),
            image_size=self._image_sizes[rooms[0]],
            instance_ids=ids,
            room_ids=tuple(self.plain_ids[room] for room in rooms),
        )

    def _draw(self, row: int, epoch: int) -> np.ndarray:
        # A pure function of seed, row and epoch: a resumed run draws what it would have drawn.
        allowed = self._allowed[row // self.rotations]
        generator = np.random.default_rng([self.seed, row, max(epoch, 0)])
        if len(allowed) >= self.views_per_room:
            return generator.choice(allowed, self.views_per_room, replace=False)
        # A room with few views shows each of them about equally often.
        return np.resize(generator.permutation(allowed), self.views_per_room)
