"""The rooms of a split with their lifted boxes and shapes, in memory, for training in 3D."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.classes import VOID
from sceneprior.core.data.dataset import BLANK, RoomDataset, allowed_views
from sceneprior.core.errors import ShardError
from sceneprior.core.geometry.turns import turn_boxes
from sceneprior.core.parts import filled_cells
from sceneprior.core.shards import RoomViews, Shard
from sceneprior.core.views import LiftedRooms
from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.lifting.cache import LiftedCache, fingerprint
from sceneprior.lifted.lifting.lifted import HANGS_M, RayPool, ShapeGrid
from sceneprior.lifted.prototypes import Prototypes, choose_prototypes, turned_looks


class LiftedDataset(RoomDataset):
    """Tracked objects of a split with the 3D boxes estimated from their masks; rows and turns are
    those of `ViewDataset`.

    Boxes are computed once and cached beside the shards (`LiftedCache`); visual hulls, rays and
    parts likewise, if `shape` gives the hulls' grid.
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
        key = fingerprint(rooms, checksums, chosen)
        self._cache = LiftedCache(folder, split, chosen, key)
        counts = [len(room.object_class) for room in rooms]
        self.boxes = self._cache.boxes(counts)
        self.max_objects = max(counts)
        self._counts = torch.tensor(counts)
        self._classes = _padded([room.object_class.astype(np.int64) for room in rooms])
        self._lifted = _padded([boxes.explained > 0 for boxes in self.boxes])
        self._boxes_m = _padded(
            [np.hstack([boxes.centers_m, boxes.sizes_m]).astype(np.float32) for boxes in self.boxes]
        )
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
        self._looks: Tensor | None = None
        """Looks by room and quarter turn."""
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
        from sceneprior.lifted.lifting.kinds import fit_kinds

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
            lambda: fit_kinds(items, hulls, self.rays, sizes_m, labels, self.usable, hangs, margin),
        )
        grids = [filled_cells(each, self._shape.cells, margin) for each in parts]
        return Prototypes(parts, np.stack(grids), sizes_m[items], labels[items], common)

    def looks_of(self, prototypes: Prototypes) -> Int[np.ndarray, " objects"]:
        """The look of each object; -1 if it is not usable or its class has no prototype."""
        from sceneprior.lifted.lifting.kinds import looks_of

        assert self._shape is not None, "opened with shapes"
        margin = self._shape.margin
        looks = looks_of(prototypes, self.rays, self.sizes_m, self.object_classes, margin)
        return np.where(self.usable, looks, -1)

    def see_looks(self, prototypes: Prototypes) -> None:
        """Assign a look to every object, in every turn of its room; batches have no looks before
        this.

        The prototypes should come from the checkpoint, if there is one: recomputed on another
        processor, they may differ.
        """
        looks = torch.from_numpy(self.looks_of(prototypes))[None].expand(self.rotations, -1)
        turned = turned_looks(
            looks.clamp(min=0), torch.arange(self.rotations), torch.zeros(self.rotations).bool()
        )
        turned = turned.where(looks >= 0, -1)
        parts = turned.T.split(self._counts.tolist())
        padded = torch.nn.utils.rnn.pad_sequence(list(parts), batch_first=True, padding_value=-1)
        self._looks = padded.transpose(1, 2).to(self._counts.device)

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
        self._counts, self._classes = self._counts.to(device), self._classes.to(device)
        self._lifted, self._boxes_m = self._lifted.to(device), self._boxes_m.to(device)
        self._looks = None if self._looks is None else self._looks.to(device)
        return self

    def __getitems__(self, draws: list[tuple[int, int]]) -> LiftedRooms:
        """A batch of rows; each draw is (row, epoch). A draw of epoch `BLANK` is an empty room;
        other epochs are ignored."""
        device = self._counts.device
        rows = torch.tensor([row for row, _ in draws], device=device)
        shown = torch.tensor([epoch != BLANK for _, epoch in draws], device=device)
        rooms, quarters = rows // self.rotations, rows % self.rotations
        counts = self._counts[rooms] * shown
        widest = max(int(counts.max()), 1)
        is_object = torch.arange(widest, device=device) < counts[:, None]
        return LiftedRooms(
            room_index=rows,
            object_class=self._classes[rooms, :widest] * is_object,
            is_object=is_object,
            is_lifted=self._lifted[rooms, :widest] & is_object,
            boxes_m=turn_boxes(self._boxes_m[rooms, :widest], quarters),
            looks=None if self._looks is None else self._looks[rooms, quarters, :widest],
            room_ids=tuple(self.plain_ids[room] for room in rooms.tolist()),
        )


def _padded(parts: Sequence[np.ndarray]) -> Tensor:
    """Per-room arrays of objects, padded to one tensor."""
    return torch.nn.utils.rnn.pad_sequence([torch.from_numpy(a) for a in parts], batch_first=True)
