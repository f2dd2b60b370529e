"""The rooms of one split as `lifting` sees them, in memory: the 2D door to 3D training."""

import contextlib
import hashlib
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from sceneprior.data.dataset import BLANK, RoomDataset, allowed_views
from sceneprior.files import write_whole
from sceneprior.geometry.turns import turn_boxes, turn_vectors
from sceneprior.lifting.boxes import LiftedBoxes, lift_boxes
from sceneprior.lifting.rays import RayPool, draw_rays
from sceneprior.shards import RoomViews, Shard, iterate_rooms
from sceneprior.views import LiftedRooms

VERSION = 1
"""Of what `lift_boxes` finds: raise it when the same views give other boxes."""


class LiftedDataset(RoomDataset):
    """Tracked objects of a split with the 3D boxes that their masks imply; rows and turns are
    `ViewDataset`'s.

    Boxes are found once, a fifth of a CPU second an object, and kept as `lifted_<split>.npz`
    beside the shards, if that folder may be written to.

    Args:
        folder, split, rotations: See `RoomDataset`.
        view_fraction, seed: As for `ViewDataset`.
        rays_per_object: Rays drawn through an object's masks each time; 0 reads no images.

    Raises:
        ShardError: a shard is missing, damaged, or of another label set than the first.
    """

    counted = "tracked objects"

    def __init__(
        self,
        folder: Path,
        split: str,
        rotations: int = 1,
        view_fraction: float = 1.0,
        rays_per_object: int = 0,
        seed: int = 0,
        pool: int = 768,
    ):
        super().__init__(rotations)
        self.seed, self.rays_per_object = seed, rays_per_object
        rooms = self.read_rooms(folder, split, Shard.read_room)
        chosen = [
            allowed_views(seed, index, len(room.visible), view_fraction)
            for index, room in enumerate(rooms)
        ]
        self.boxes = _find_boxes(Path(folder), split, rooms, chosen)
        counts = np.array([len(room.object_class) for room in rooms])
        self.max_objects = int(counts.max())
        self._counts = torch.from_numpy(counts)
        self._classes, self._lifted, self._boxes_m = (
            torch.nn.utils.rnn.pad_sequence([torch.from_numpy(a) for a in parts], batch_first=True)
            for parts in (
                [room.object_class.astype(np.int64) for room in rooms],
                [boxes.explained > 0 for boxes in self.boxes],
                [
                    np.hstack([boxes.centers_m, boxes.sizes_m]).astype(np.float32)
                    for boxes in self.boxes
                ],
            )
        )
        self._rays: list[RayPool] = []
        if rays_per_object:
            for index, (shard, room_id) in enumerate(iterate_rooms(folder, split)):
                views = shard.read_room(room_id, images=True)
                self._rays.append(draw_rays(views, self.boxes[index], pool, chosen[index], seed))

    def to(self, device: torch.device | str) -> "LiftedDataset":
        """Move all boxes to `device`, where batches are then made."""
        self._counts, self._classes = self._counts.to(device), self._classes.to(device)
        self._lifted, self._boxes_m = self._lifted.to(device), self._boxes_m.to(device)
        return self

    def __getitems__(self, draws: list[tuple[int, int]]) -> LiftedRooms:
        """A batch of rows; each draw is (row, epoch), which together decide its rays. A draw of an
        epoch `BLANK` is a room in which there is nothing."""
        device = self._counts.device
        rows = torch.tensor([row for row, _ in draws], device=device)
        shown = torch.tensor([epoch != BLANK for _, epoch in draws], device=device)
        rooms, quarters = rows // self.rotations, rows % self.rotations
        counts = self._counts[rooms] * shown
        widest = max(int(counts.max()), 1)
        is_object = torch.arange(widest, device=device) < counts[:, None]
        lifted = LiftedRooms(
            room_index=rows,
            object_class=self._classes[rooms, :widest] * is_object,
            is_object=is_object,
            is_lifted=self._lifted[rooms, :widest] & is_object,
            boxes_m=turn_boxes(self._boxes_m[rooms, :widest], quarters),
            room_ids=tuple(self.plain_ids[room] for room in rooms.tolist()),
            **(self._draw_rays(draws, widest) if self._rays else {}),
        )
        return lifted

    def _draw_rays(self, draws: list[tuple[int, int]], widest: int) -> dict[str, Tensor]:
        many = self.rays_per_object
        origins = np.zeros((len(draws), widest, many, 3), np.float32)
        directions = np.ones_like(origins)
        hits = np.zeros((len(draws), widest, many), bool)
        until = np.zeros((len(draws), widest, many), np.float32)
        for place, (row, epoch) in enumerate(draws):
            pool = self._rays[row // self.rotations]
            count = 0 if epoch == BLANK else len(pool.hits)
            # A pure function of seed, row and epoch: a resumed run draws what it would have drawn.
            rng = np.random.default_rng([self.seed, row, max(epoch, 0)])
            picked = rng.integers(pool.hits.shape[1], size=(count, many))
            item = np.arange(count)[:, None]
            origins[place, :count] = pool.origins_m[item, picked]
            directions[place, :count] = pool.directions[item, picked]
            hits[place, :count] = pool.hits[item, picked]
            until[place, :count] = pool.until_m[item, picked]
        device = self._counts.device
        quarters = torch.tensor([row % self.rotations for row, _ in draws], device=device)
        return {
            "ray_origins_m": turn_vectors(torch.from_numpy(origins).to(device), quarters),
            "ray_directions": turn_vectors(torch.from_numpy(directions).to(device), quarters),
            "ray_hits": torch.from_numpy(hits).to(device),
            "ray_until_m": torch.from_numpy(until).to(device),
        }


def _find_boxes(
    folder: Path, split: str, rooms: Sequence[RoomViews], chosen: Sequence[np.ndarray]
) -> list[LiftedBoxes]:
    path = folder / f"lifted_{split}.npz"
    key = _fingerprint(rooms, chosen)
    ends = np.cumsum([len(room.object_class) for room in rooms])[:-1]
    try:
        with np.load(path) as saved:
            if str(saved["key"]) == key:
                parts = [np.split(saved[name], ends) for name in LiftedBoxes._fields]
                return [LiftedBoxes(*each) for each in zip(*parts, strict=True)]
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        pass  # not there yet, or not to be trusted: found again
    progress = track(chosen, "lifting boxes from masks (rooms)", console=Console(stderr=True))
    found = [
        lift_boxes(shard.read_room(room_id, images=True), views)
        for views, (shard, room_id) in zip(progress, iterate_rooms(folder, split), strict=True)
    ]
    named = {
        name: np.concatenate([getattr(room, name) for room in found])
        for name in LiftedBoxes._fields
    }
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, key=np.array(key), **named)
    with contextlib.suppress(OSError):  # a folder of shards may be read-only: found again then
        write_whole(path, buffer.getvalue())
    return found


def _fingerprint(rooms: Sequence[RoomViews], chosen: Sequence[np.ndarray]) -> str:
    """Changes with all that boxes are found from, but for the images, which say the same."""
    summary = hashlib.sha256(f"lifted {VERSION}".encode())
    for room, views in zip(rooms, chosen, strict=True):
        summary.update(room.room_id.encode())
        for array in (room.boxes, room.mask_pixels, room.world_to_camera, room.intrinsics, views):
            summary.update(np.ascontiguousarray(array).data)
    return summary.hexdigest()
