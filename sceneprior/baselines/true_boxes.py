"""A folder of shards in, batches of true 3D boxes out: for the baselines with 3D supervision.

The only door from training to the shards' ground truth. The stages `atiss3d` and `sync2gen` open
it; what learns from masks and 2D boxes never does (tests/baselines/test_true_boxes.py).
"""

import math
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.utils.data import Dataset

from sceneprior.data.dataset import BLANK, TURNS
from sceneprior.errors import ShardError
from sceneprior.geometry.turns import turn_vectors
from sceneprior.shards import iterate_rooms
from sceneprior.views import RoomBoxes


class TruthDataset(Dataset):
    """Every furnished box of every room of a split, in memory; rows and turns are `ViewDataset`'s.

    All furniture that has a class counts, seen by a camera or not: who is given the room in 3D is
    given all of it.

    Args:
        folder: Of shards with ground truth.
        split: `train` or `test`.
        rotations: 4 adds each room turned by 90, 180 and 270 degrees; 1 does not.

    Raises:
        ShardError: a shard is missing, damaged, without ground truth, or labelled otherwise than
            the first.
    """

    masks = None
    """No images are read: batches are made in the training process (data/datamodule.py)."""

    def __init__(self, folder: Path, split: str, rotations: int = 1):
        self.rotations = rotations
        self.label_set = ""
        ids, classes, boxes, yaws = [], [], [], []
        for shard, room_id in iterate_rooms(folder, split):
            if self.label_set and shard.label_set != self.label_set:
                raise ShardError(
                    f"{shard.path} is labelled '{shard.label_set}' but its neighbours "
                    f"'{self.label_set}'; keep one label set a folder."
                )
            self.label_set = shard.label_set
            if not shard.has_ground_truth(room_id):
                raise ShardError(
                    f"{shard.path}, room {room_id} carries no 3D ground truth, which is what this "
                    "stage learns from. Take shards of a data set that has it, or a stage that "
                    "learns from masks (stages: two)."
                )
            truth = shard.read_ground_truth(room_id)
            ids.append(room_id)
            classes.append(torch.from_numpy(truth.object_class).long())
            boxes.append(torch.from_numpy(np.hstack([truth.centers_m, truth.sizes_m])))
            yaws.append(torch.from_numpy(truth.yaw_rad))
        if not ids:
            raise ShardError(f"The shards of {folder}/{split} hold no rooms; prepare them again.")
        self._plain_ids = tuple(ids)
        self._counts = torch.tensor([len(room) for room in classes])
        self._classes = torch.nn.utils.rnn.pad_sequence(classes, batch_first=True)
        self._boxes_m = torch.nn.utils.rnn.pad_sequence(boxes, batch_first=True)
        self._yaw_rad = torch.nn.utils.rnn.pad_sequence(yaws, batch_first=True)

    def __len__(self) -> int:
        return len(self._plain_ids) * self.rotations

    @property
    def max_objects(self) -> int:
        """Objects of the fullest room."""
        return int(self._counts.max())

    @property
    def room_ids(self) -> tuple[str, ...]:
        """One id a row: the room's, with `@90` and so on for its turned copies."""
        turns = TURNS[: self.rotations]
        return tuple(room_id + turn for room_id in self._plain_ids for turn in turns)

    def to(self, device: torch.device | str) -> "TruthDataset":
        """Move all boxes to `device`, where batches are then made."""
        self._counts, self._classes = self._counts.to(device), self._classes.to(device)
        self._boxes_m, self._yaw_rad = self._boxes_m.to(device), self._yaw_rad.to(device)
        return self

    def everything(self) -> RoomBoxes:
        """All rows as one batch: what statistics are taken from."""
        return self.__getitems__([(row, 0) for row in range(len(self))])

    def __getitems__(self, draws: list[tuple[int, int]]) -> RoomBoxes:
        """A batch of rows; each draw is (row, epoch). A draw of an epoch `BLANK` is a room in which
        there is nothing, and which has no id: it teaches nothing."""
        device = self._counts.device
        rows = torch.tensor([row for row, _ in draws], device=device)
        shown = torch.tensor([epoch != BLANK for _, epoch in draws], device=device)
        rooms = rows // self.rotations
        counts = self._counts[rooms] * shown
        widest = max(int(counts.max()), 1)
        is_object = torch.arange(widest, device=device) < counts[:, None]
        quarters = rows % self.rotations
        yaw_rad = self._yaw_rad[rooms, :widest] + math.pi / 2 * quarters.unsqueeze(-1)
        return RoomBoxes(
            object_class=self._classes[rooms, :widest] * is_object,
            is_object=is_object,
            boxes_m=turned(self._boxes_m[rooms, :widest], quarters),
            room_ids=tuple(self._plain_ids[room] for room in rooms[shown].tolist()),
            yaw_rad=torch.remainder(yaw_rad + math.pi, 2 * math.pi) - math.pi,
        )


def turned(
    boxes_m: Float[Tensor, "rooms objects 6"], quarters: Int[Tensor, " rooms"]
) -> Float[Tensor, "rooms objects 6"]:
    """Boxes of rooms turned about +y by so many quarters: x goes to -z, z to x."""
    centers_m, sizes_m = boxes_m.split(3, dim=-1)
    return torch.cat([turn_vectors(centers_m, quarters), turn_vectors(sizes_m, quarters).abs()], -1)
