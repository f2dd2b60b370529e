"""The rooms of a split with their lifted boxes and shapes, in memory, for training in 3D."""

import contextlib
import hashlib
import io
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from rich.console import Console
from rich.progress import track
from torch import Tensor

from sceneprior.core.classes import VOID
from sceneprior.core.data.dataset import BLANK, RoomDataset, allowed_views
from sceneprior.core.errors import ShardError
from sceneprior.core.files import write_whole
from sceneprior.core.geometry.turns import turn_boxes
from sceneprior.core.parts import filled_cells
from sceneprior.core.shards import RoomViews, Shard, iterate_rooms
from sceneprior.core.views import LiftedRooms
from sceneprior.core.wall_lines import Wall, find_walls
from sceneprior.lifted.lifting.lifted import HANGS_M, LiftedBoxes, RayPool, ShapeGrid
from sceneprior.lifted.prototypes import Prototypes, choose_prototypes, turned_looks

VERSION = 2
"""Version of the cached boxes."""
SHAPES_VERSION = 5
"""Version of the cached hulls and rays. Increase this, or `VERSION`, when results change."""

WALLS_VERSION = 1
"""Version of the cached walls."""

RAYS_KEPT = 1024
"""Number of rays per object from which its shape is found."""


class LiftedDataset(RoomDataset):
    """Tracked objects of a split with the 3D boxes estimated from their masks; rows and turns are
    those of `ViewDataset`.

    Boxes are computed once and cached as `lifted_<split>.npz` beside the shards if that folder is
    writable; visual hulls and rays likewise, if `shape` gives the hulls' grid.
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
        key = _fingerprint(rooms, checksums, chosen)
        self._walls_at = folder, split, key, chosen
        counts = [len(room.object_class) for room in rooms]
        self.boxes = _find_boxes(folder, split, key, counts, chosen)
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
            found = _find_shapes(folder, split, key, rooms, self.boxes, chosen, shape)
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
        parts = fit_kinds(items, hulls, self.rays, sizes_m, labels, self.usable, hangs, margin)
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
        """Walls of each room, found in its masks; none if its shard has no stuff. They are cached
        as `lifted_walls_<split>.npz`."""
        return _find_walls(*self._walls_at)

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


def _find_boxes(
    folder: Path, split: str, key: str, counts: Sequence[int], chosen: Sequence[np.ndarray]
) -> list[LiftedBoxes]:
    def find() -> dict[str, np.ndarray]:
        from sceneprior.lifted.lifting.boxes import lift_boxes

        progress = track(chosen, "lifting boxes from masks (rooms)", console=Console(stderr=True))
        found = [
            lift_boxes(shard.read_room(room_id, images=True), views)
            for views, (shard, room_id) in zip(progress, iterate_rooms(folder, split), strict=True)
        ]
        return {
            name: np.concatenate([getattr(room, name) for room in found])
            for name in LiftedBoxes._fields
        }

    saved = _kept(folder / f"lifted_{split}.npz", key, find)
    parts = [np.split(saved[name], np.cumsum(counts)[:-1]) for name in LiftedBoxes._fields]
    return [LiftedBoxes(*each) for each in zip(*parts, strict=True)]


def _find_shapes(
    folder: Path,
    split: str,
    key: str,
    rooms: Sequence[RoomViews],
    boxes: Sequence[LiftedBoxes],
    chosen: Sequence[np.ndarray],
    shape: ShapeGrid,
) -> dict[str, np.ndarray]:
    """Visual hulls (`bits`), packed to eight cells per byte, and the fields of a `RayPool`."""

    def find() -> dict[str, np.ndarray]:
        from sceneprior.lifted.lifting.rays import draw_rays
        from sceneprior.lifted.lifting.shapes import lift_shapes

        hulls, rays = [], []
        progress = track(boxes, "lifting shapes from masks (rooms)", console=Console(stderr=True))
        for its_boxes, views, (shard, room_id) in zip(
            progress, chosen, iterate_rooms(folder, split), strict=True
        ):
            room = shard.read_room(room_id, images=True)
            hulls.append(lift_shapes(room, its_boxes, shape, views))
            rays.append(draw_rays(room, its_boxes, RAYS_KEPT, shape.margin, views))
        grids = np.concatenate(hulls)
        starts, spans, hits = (np.concatenate(part) for part in zip(*rays, strict=True))
        return {
            "bits": np.packbits(grids.reshape(len(grids), -1), axis=1),
            "starts": starts.astype(np.float16),
            "spans": spans.astype(np.float16),
            "hits": hits,
        }

    key = f"{key} {SHAPES_VERSION} {shape.cells} {shape.margin}"
    return _kept(folder / f"lifted_shapes_{split}.npz", key, find)


def _find_walls(
    folder: Path, split: str, key: str, chosen: Sequence[np.ndarray]
) -> list[list[Wall]]:
    def find() -> dict[str, np.ndarray]:
        found = [
            find_walls(shard.read_room(room_id, images=True), views)[0]
            if shard.has_stuff(room_id)
            else ()
            for views, (shard, room_id) in zip(chosen, iterate_rooms(folder, split), strict=True)
        ]
        rows = [np.hstack(wall) for walls in found for wall in walls]
        return {
            "walls": np.array(rows).reshape(-1, 7),
            "counts": np.array([len(walls) for walls in found]),
        }

    saved = _kept(folder / f"lifted_walls_{split}.npz", f"{key} {WALLS_VERSION}", find)
    parts = np.split(saved["walls"], np.cumsum(saved["counts"])[:-1])
    return [[Wall(row[:2], row[2:4], row[4:6], float(row[6])) for row in part] for part in parts]


def _kept(path: Path, key: str, find: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Read the arrays cached in a file under this key. If they are missing, compute them, and cache
    them if the file is writable."""
    try:
        with np.load(path) as saved:
            if str(saved["key"]) == key:
                return {name: saved[name] for name in saved.files}
    except (OSError, KeyError, ValueError, zipfile.BadZipFile):
        pass  # missing or damaged: computed again
    found = find()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, key=np.array(key), **found)
    with contextlib.suppress(OSError):  # a read-only folder gets no cache
        write_whole(path, buffer.getvalue())
    return found


def _fingerprint(
    rooms: Sequence[RoomViews], checksums: Sequence[str | None], chosen: Sequence[np.ndarray]
) -> str:
    """Hash of everything from which boxes and shapes are computed. A room's checksum covers its
    images; for old shards without checksums, measurements taken from the images replace it."""
    summary = hashlib.sha256(f"lifted {VERSION}".encode())
    for room, checksum, views in zip(rooms, checksums, chosen, strict=True):
        summary.update(f"{room.room_id} {checksum}".encode())
        for array in (
            room.object_class, room.boxes, room.mask_pixels, room.sides_clear,
            room.world_to_camera, room.intrinsics, views,
        ):  # fmt: skip
            summary.update(np.ascontiguousarray(array).data)
    return summary.hexdigest()
