"""The rooms of one split of a shard folder, in memory, and batches of their views."""

from pathlib import Path

import numpy as np
import torch
from torch.utils.data import Dataset

from sceneprior.data.flat_views import FlatViews
from sceneprior.data.masks import MaskStore
from sceneprior.errors import ShardError
from sceneprior.shards import RoomViews, Shard, list_shards
from sceneprior.views import SceneViews

BLANK = -1
"""An epoch no one draws in: the room comes without objects, and teaches nothing."""
TURNS = ("", "@90", "@180", "@270")
"""What marks the id of a room that was turned about +y by so many quarters."""


class ViewDataset(Dataset):
    """Rooms of a split with their views; images are read only where masks are wanted.

    Boxes and cameras of the whole split are in memory, flat: tens of MB for 100,000 views. `to`
    moves them to a GPU, and batches are made there. Masks are read view by view.

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

    counted = "tracked objects"
    """What `max_objects` counts, in words."""

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
        self.seed = seed
        self.label_set = ""
        rooms: list[RoomViews] = []
        places: list[tuple[Path, str]] = []
        for path in list_shards(folder, split):
            if limit is not None and len(rooms) >= limit:
                break
            with Shard(path) as shard:
                if self.label_set and shard.label_set != self.label_set:
                    raise ShardError(
                        f"{path} is labelled '{shard.label_set}' but its neighbours "
                        f"'{self.label_set}'; keep one label set a folder."
                    )
                self.label_set = shard.label_set
                left = None if limit is None else limit - len(rooms)
                for room_id in shard.room_ids[:left]:
                    rooms.append(shard.read_room(room_id))
                    places.append((path, room_id))
        if not rooms:
            raise ShardError(f"The shards of {folder}/{split} hold no rooms; prepare them again.")
        self.flat = FlatViews.of(rooms)
        self.masks = None if mask_step is None else MaskStore(places, mask_step)
        self._plain_ids = tuple(room.room_id for room in rooms)
        self._image_sizes = tuple(room.image_size for room in rooms)
        self._object_counts = np.array([len(room.object_class) for room in rooms])
        self._allowed = [
            self._choose(index, len(room.visible), view_fraction)
            for index, room in enumerate(rooms)
        ]

    def _choose(self, index: int, count: int, fraction: float) -> np.ndarray:
        keep = max(1, round(fraction * count))
        order = np.random.default_rng([self.seed, index]).permutation(count)
        return np.sort(order[:keep])

    def __len__(self) -> int:
        return len(self._plain_ids) * self.rotations

    @property
    def max_objects(self) -> int:
        """Tracked objects of the fullest room."""
        return int(self._object_counts.max())

    @property
    def room_ids(self) -> tuple[str, ...]:
        """One id a row: the room's, with `@90` and so on for its turned copies."""
        turns = TURNS[: self.rotations]
        return tuple(room_id + turn for room_id in self._plain_ids for turn in turns)

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
        device = self.flat.device
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
            room_ids=tuple(self._plain_ids[room] for room in rooms),
        )

    def _draw(self, row: int, epoch: int) -> np.ndarray:
        # A pure function of seed, row and epoch: a resumed run draws what it would have drawn.
        allowed = self._allowed[row // self.rotations]
        generator = np.random.default_rng([self.seed, row, max(epoch, 0)])
        if len(allowed) >= self.views_per_room:
            return generator.choice(allowed, self.views_per_room, replace=False)
        # A room with few views shows each of them about equally often.
        return np.resize(generator.permutation(allowed), self.views_per_room)
