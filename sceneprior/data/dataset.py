"""One split of a shard folder in memory; lists of (row, epoch) in, `SceneViews` out."""

from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from sceneprior.batches import SceneViews
from sceneprior.errors import ShardError
from sceneprior.shards import RoomViews, Shard, list_shards

BLANK = -1
"""An epoch no one draws in: the room comes without objects, and teaches nothing."""


class ViewDataset(Dataset):
    """Rooms of a split with their views; images are read only where masks are wanted.

    Args:
        folder: Shard folder.
        split: `train` or `test`.
        views_per_room: Views drawn each time a room is asked for.
        rotations: 1, or 4 to add each room turned by 90, 180 and 270 degrees.
        view_fraction: Share of each room's views that may be drawn, chosen once by `seed`.
        mask_step: Every how many pixels the instance ids are kept; None reads no images.
        seed: Decides which views are drawn.
        limit: Only the first so many rooms; None takes all.

    Raises:
        ShardError: a shard is missing, damaged, or of another label set than the first.
    """

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
    ):
        self.views_per_room = views_per_room
        self.rotations = rotations
        self.mask_step = mask_step
        self.seed = seed
        self.rooms: list[RoomViews] = []
        self._paths: list[Path] = []
        self._images: dict[int, np.ndarray] = {}
        self.label_set = ""
        for path in list_shards(folder, split):
            if limit is not None and len(self.rooms) >= limit:
                break
            with Shard(path) as shard:
                if self.label_set and shard.label_set != self.label_set:
                    raise ShardError(
                        f"{path} is labelled '{shard.label_set}' but its neighbours "
                        f"'{self.label_set}'; keep one label set a folder."
                    )
                self.label_set = shard.label_set
                left = None if limit is None else limit - len(self.rooms)
                for room_id in shard.room_ids[:left]:
                    self.rooms.append(shard.read_room(room_id))
                    self._paths.append(path)
        if not self.rooms:
            raise ShardError(f"The shards of {folder}/{split} hold no rooms; prepare them again.")
        self._allowed = [self._choose(index, view_fraction) for index in range(len(self.rooms))]
        self.max_objects = max(len(room.object_class) for room in self.rooms)
        self._turns = [_turn_about_up(quarter) for quarter in range(4)]

    def _choose(self, index: int, fraction: float) -> np.ndarray:
        count = len(self.rooms[index].visible)
        keep = max(1, round(fraction * count))
        order = np.random.default_rng([self.seed, index]).permutation(count)
        return np.sort(order[:keep])

    def __len__(self) -> int:
        return len(self.rooms) * self.rotations

    @property
    def room_ids(self) -> tuple[str, ...]:
        """One id a row: the room's, with `@90` and so on for its turned copies."""
        turns = ("", "@90", "@180", "@270")[: self.rotations]
        return tuple(room.room_id + turn for room in self.rooms for turn in turns)

    def __getitems__(self, draws: list[tuple[int, int]]) -> SceneViews:
        """A batch of rows; each draw is (row, epoch), which together decide its views."""
        rows = [row for row, _ in draws]
        rooms = [self.rooms[row // self.rotations] for row in rows]
        chosen = [self._draw(row, epoch) for row, epoch in draws]
        objects = max(len(room.object_class) for room in rooms)
        shape = (len(rows), self.views_per_room)
        classes = np.zeros((len(rows), objects), dtype=np.int64)
        real = np.zeros((len(rows), objects), dtype=bool)
        boxes = np.zeros((*shape, objects, 4), dtype=np.float32)
        visible = np.zeros((*shape, objects), dtype=bool)
        clear = np.zeros((*shape, objects, 4), dtype=bool)
        poses = np.empty((*shape, 4, 4), dtype=np.float32)
        lenses = np.empty((*shape, 3, 3), dtype=np.float32)
        for slot, (row, room, views) in enumerate(zip(rows, rooms, chosen, strict=True)):
            count = len(room.object_class) if draws[slot][1] != BLANK else 0
            classes[slot, :count] = room.object_class[:count]
            real[slot, :count] = True
            boxes[slot, :, :count] = room.boxes[views, :count]
            visible[slot, :, :count] = room.visible[views, :count]
            clear[slot, :, :count] = room.sides_clear[views, :count]
            # The room turns by +a, so a camera sees the turned room as it saw the plain one.
            poses[slot] = room.world_to_camera[views] @ self._turns[row % self.rotations].T
            lenses[slot] = room.intrinsics[views]
        ids = None
        if self.mask_step is not None:
            ids = torch.from_numpy(
                np.stack([self._ids(row)[v] for row, v in zip(rows, chosen, strict=True)])
            )
        return SceneViews(
            room_index=torch.tensor(rows),
            object_class=torch.from_numpy(classes),
            is_object=torch.from_numpy(real),
            world_to_camera=torch.from_numpy(poses),
            intrinsics=torch.from_numpy(lenses),
            boxes=torch.from_numpy(boxes),
            visible=torch.from_numpy(visible),
            sides_clear=torch.from_numpy(clear),
            image_size=rooms[0].image_size,
            instance_ids=ids,
            room_ids=tuple(room.room_id for room in rooms),
        )

    def _draw(self, row: int, epoch: int) -> np.ndarray:
        # A pure function of seed, row and epoch: a resumed run draws what it would have drawn.
        allowed = self._allowed[row // self.rotations]
        generator = np.random.default_rng([self.seed, row, max(epoch, 0)])
        if len(allowed) >= self.views_per_room:
            return generator.choice(allowed, self.views_per_room, replace=False)
        # A room with few views shows each of them about equally often.
        return np.resize(generator.permutation(allowed), self.views_per_room)

    def _ids(self, row: int) -> np.ndarray:
        index = row // self.rotations
        if index not in self._images:
            room = self.rooms[index]
            with Shard(self._paths[index]) as shard:
                self._images[index] = shard.read_instance_ids(
                    room.room_id, range(len(room.visible)), self.mask_step or 1
                )
        return self._images[index]


def _turn_about_up(quarter: int) -> np.ndarray:
    """(4, 4) rotation by quarter * 90 degrees about +y, exact."""
    cosine, sine = ((1, 0), (0, 1), (-1, 0), (0, -1))[quarter]
    turn = np.eye(4, dtype=np.float32)
    turn[0, 0] = turn[2, 2] = cosine
    turn[0, 2], turn[2, 0] = sine, -sine
    return turn
