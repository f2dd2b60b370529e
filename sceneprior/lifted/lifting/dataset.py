"""The rooms of a split with their lifted boxes and shapes, in memory, for training in 3D."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sceneprior.core.boxes import turn_boxes
from sceneprior.core.classes import VOID
from sceneprior.core.dataset import BLANK, RoomDataset, allowed_views
from sceneprior.core.errors import ShardError
from sceneprior.core.observations import RoomViews
from sceneprior.core.parts import filled_cells
from sceneprior.core.shards import Shard
from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.lifting import HANGS_M, RayPool, ShapeGrid
from sceneprior.lifted.lifting.cache import LiftedCache, fingerprint
from sceneprior.lifted.prototypes import Prototypes, choose_prototypes, turn_posed
from sceneprior.lifted.rooms import LiftedRooms


class LiftedDataset(RoomDataset):
    """Tracked objects of a split with the 3D boxes estimated from their masks; rows and turns are
    those of `ViewDataset`.

    Visual hulls, rays and parts are lifted as well if `shape` gives the hulls' grid.
    `view_fraction` and `seed` are those of `ViewDataset`. If no object is visible in two views, a
    `ShardError` says so.
    """

    counted = "tracked objects"

    def __init__(
        self,
        folder: Path,
        split: str,
        rotations: int = 1,
        view_fraction: float = 1.0,
        shape: ShapeGrid | None = None,
        seed: int = 0,
    ):
        super().__init__(rotations)
        folder = Path(folder)
        checksums: list[str | None] = []

        def read(shard: Shard, room_id: str) -> RoomViews:
            checksums.append(shard.read_checksum(room_id))
            return shard.read_room(room_id)

        rooms = self.read_rooms(folder, split, read)
        chosen = [
            allowed_views(seed, index, len(room.visible), view_fraction)
            for index, room in enumerate(rooms)
        ]
        self._cache = LiftedCache(folder, split, chosen, fingerprint(rooms, checksums, chosen))
        counts = [len(room.object_class) for room in rooms]
        self.boxes = self._cache.boxes(counts)
        self.max_objects = max(counts)
        self.object_classes = np.concatenate([room.object_class for room in rooms]).astype(np.int64)
        """Classes of all objects, room after room."""
        if not self.usable.any():
            views = sum(map(len, chosen))
            raise ShardError(
                f"None of the {len(self.object_classes)} objects in the {len(rooms)} '{split}' "
                f"rooms of {folder} can be lifted to 3D: that takes masks, more than 4 pixels wide "
                f"and high, in at least two views of a room, and here are {views} views (at "
                f"data.view_fraction {view_fraction:g}). Prepare more or larger views of each room."
            )
        self._rooms = LiftedRooms(
            room_index=torch.arange(len(rooms)),
            object_class=_padded([room.object_class.astype(np.int64) for room in rooms]),
            is_object=_padded([np.ones(count, dtype=bool) for count in counts]),
            is_lifted=_padded([boxes.explained > 0 for boxes in self.boxes]),
            boxes_m=_padded(
                [np.hstack([b.centers_m, b.sizes_m]).astype(np.float32) for b in self.boxes]
            ),
        )
        self._shape = shape
        if shape is not None:
            found = self._cache.shapes(self.boxes, shape)
            self._bits = found["bits"]
            self.rays = RayPool(*(found[name] for name in RayPool._fields))
            """Rays around the masks of all objects, room after room."""

    @property
    def usable(self) -> Bool[np.ndarray, " objects"]:
        """True for objects with a label and a lifted box, and so a shape; room after room."""
        known = np.concatenate([room.explained > 0 for room in self.boxes])
        return known & (self.object_classes != VOID)

    @property
    def sizes_m(self) -> Float[np.ndarray, "objects 3"]:
        """Full extents, room after room; 1 m for objects that are not usable."""
        sizes_m = np.concatenate([room.sizes_m for room in self.boxes])
        return np.where(self.usable[:, None], sizes_m, 1.0)

    def find_prototypes(self, most: int) -> Prototypes:
        """Choose at most `most` prototypes, made of parts, that represent all usable objects."""
        # Imported only where something is lifted, here and below, since Numba is slow to import.
        from sceneprior.lifted.lifting.prototype_fitting import fit_prototypes

        assert self._shape is not None, "opened with shapes"
        hulls, sizes_m, labels = self.hulls(), self.sizes_m, self.object_classes
        items, common = choose_prototypes(hulls, sizes_m, labels, self.usable, most)
        margin = self._shape.margin
        bottoms_m = np.concatenate(
            [room.centers_m[:, 1] - room.sizes_m[:, 1] / 2 for room in self.boxes]
        )
        hangs = bottoms_m > HANGS_M
        parts = self._cache.parts(
            items,
            self._shape,
            lambda: fit_prototypes(
                items, hulls, self.rays, sizes_m, labels, self.usable, hangs, margin
            ),
        )
        grids = [filled_cells(each, self._shape.cells, margin) for each in parts]
        return Prototypes(parts, np.stack(grids), sizes_m[items], labels[items], common)

    def posed_prototypes(self, prototypes: Prototypes) -> Int[np.ndarray, " objects"]:
        """The look of each object; -1 if it is not usable or its class has no prototype."""
        from sceneprior.lifted.lifting.prototype_fitting import explain_rays

        assert self._shape is not None, "opened with shapes"
        margin = self._shape.margin
        looks = explain_rays(prototypes, self.rays, self.sizes_m, self.object_classes, margin)
        return np.where(self.usable, looks, -1)

    def assign_prototypes(self, prototypes: Prototypes) -> None:
        """Assign a look to every object; batches have no looks before this.

        The prototypes should come from the checkpoint, if there is one: recomputed on another
        processor, they may differ.
        """
        counts = self._rooms.is_object.sum(dim=1).tolist()
        looks = torch.from_numpy(self.posed_prototypes(prototypes)).split(counts)
        padded = pad_sequence(list(looks), batch_first=True, padding_value=-1)
        self._rooms = replace(self._rooms, looks=padded.to(self._rooms.is_object.device))

    def walls(self) -> list[list[Wall]]:
        """Walls of each room, found in its masks; none if its shard has no stuff."""
        return self._cache.walls()

    def hulls(self) -> Bool[np.ndarray, "objects x y z"]:
        """The visual hulls of all objects, room after room; see `lift_shapes`."""
        assert self._shape is not None, "opened with shapes"
        cells = self._shape.cells
        flat = np.unpackbits(self._bits, axis=1, count=cells**3).view(bool)
        return flat.reshape(-1, cells, cells, cells)

    def to(self, device: torch.device | str) -> "LiftedDataset":
        """Move all boxes and looks to `device`, on which batches are then assembled."""
        self._rooms = self._rooms.to(device)
        return self

    def __getitems__(self, draws: list[tuple[int, int]]) -> LiftedRooms:
        """A batch of rows; each draw is (row, epoch). A draw of epoch `BLANK` is an empty room;
        other epochs are ignored."""
        device = self._rooms.is_object.device
        rows = torch.tensor([row for row, _ in draws], device=device)
        shown = torch.tensor([epoch != BLANK for _, epoch in draws], device=device)
        quarters = rows % self.rotations
        batch = self._rooms.changed(lambda part: part[rows // self.rotations])
        is_object = batch.is_object & shown[:, None]
        widest = max(int(is_object.sum(dim=1).max()), 1)
        looks = batch.looks
        if looks is not None:
            turned = turn_posed(looks.clamp(min=0), quarters, torch.zeros_like(shown))
            looks = turned.where(looks >= 0, -1)[:, :widest]
        return LiftedRooms(
            room_index=rows,
            object_class=(batch.object_class * is_object)[:, :widest],
            is_object=is_object[:, :widest],
            is_lifted=(batch.is_lifted & is_object)[:, :widest],
            boxes_m=turn_boxes(batch.boxes_m, quarters)[:, :widest],
            looks=looks,
            room_ids=tuple(self.plain_ids[row // self.rotations] for row, _ in draws),
        )


def _padded(parts: Sequence[np.ndarray]) -> Tensor:
    """Per-room arrays of objects, padded to one tensor."""
    return pad_sequence([torch.from_numpy(part) for part in parts], batch_first=True)
