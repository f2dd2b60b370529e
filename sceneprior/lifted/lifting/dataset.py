"""The rooms of a split with what is lifted from their masks, in memory, for training in 3D.

Boxes, shapes, walls and parts are lifted once and cached in files beside the shards. A file is
found again when its inputs or its version changes, and is left out if the folder is not writable.
Lifting is a task per shard (core/parallel.py), whose result stays in a file of its own until all
shards are lifted.
"""

import contextlib
import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sceneprior.core.boxes import turn_boxes
from sceneprior.core.checked import keep_arrays, kept_arrays
from sceneprior.core.classes import VOID
from sceneprior.core.dataset import BLANK, RoomDataset, allowed_views
from sceneprior.core.errors import ShardError
from sceneprior.core.observations import RoomViews
from sceneprior.core.parallel import run_tasks
from sceneprior.core.parts import Parts, filled_cells
from sceneprior.core.shards import Shard
from sceneprior.core.views import Batch
from sceneprior.core.wall_lines import Wall, find_ceiling, find_walls
from sceneprior.lifted.lifting import HANGS_M, LiftedBoxes, RayPool, ShapeGrid
from sceneprior.lifted.prototypes import Prototypes, choose_prototypes, turn_posed

VERSION = 7
"""Version of the cached boxes, hulls, rays and walls. Increase a version when results change."""
PARTS_VERSION = 1
"""Version of the cached parts: increase it when `prototype_fitting.py`, `part_fit.py` and what it
imports, `ALIKE` or `HANGS_M` change; delete `lifted_parts_*.npz` while trying settings."""
RAYS_KEPT = 1024
"""Number of rays per object from which its shape is found."""


@dataclass(frozen=True)
class LiftedRooms(Batch):
    """Tracked objects of a batch of rooms, lifted to 3D from masks alone.

    Objects are padded to the largest room's count.
    """

    room_index: Int[Tensor, " rooms"]
    """Row of each room in the data set, which is also the row of its latent vector."""
    object_class: Int[Tensor, "rooms objects"]
    """Index into the label set; 0 where `is_object` is false."""
    is_object: Bool[Tensor, "rooms objects"]
    """False for padding; the first n entries of a room with n tracked objects are true."""
    is_lifted: Bool[Tensor, "rooms objects"]
    """True if the object's box is known, because some view shows the object."""
    boxes_m: Float[Tensor, "rooms objects 6"]
    """Axis-aligned boxes in the room frame: centre x, y, z, then full extents."""
    looks: Int[Tensor, "rooms objects"]
    """Look (prototype * 8 + pose) nearest to the lifted shape (`lifted/prototypes.py`); -1 if there
    is none."""
    room_ids: tuple[str, ...] = ()


class LiftedDataset(RoomDataset):
    """Tracked objects of a split with the 3D boxes estimated from their masks; rows and turns are
    those of `ViewDataset`.

    Visual hulls and parts are represented on the grid `shape`. `view_fraction` and `seed` are those
    of `ViewDataset`. If no object is visible in two views, a `ShardError` says so.
    """

    counted = "tracked objects"

    def __init__(
        self,
        folder: Path,
        split: str,
        shape: ShapeGrid,
        rotations: int = 1,
        view_fraction: float = 1.0,
        seed: int = 0,
    ):
        super().__init__(rotations)
        folder = Path(folder)
        checksums: list[str | None] = []
        paths: list[Path] = []

        def read(shard: Shard, room_id: str) -> RoomViews:
            checksums.append(shard.read_checksum(room_id))
            paths.append(shard.path)
            return shard.read_room(room_id)

        rooms = self.read_rooms(folder, split, read)
        chosen = [
            allowed_views(seed, index, len(room.visible), view_fraction)
            for index, room in enumerate(rooms)
        ]
        self.counts = [len(room.object_class) for room in rooms]
        self.max_objects = max(self.counts)
        self.object_classes = np.concatenate([room.object_class for room in rooms]).astype(np.int64)
        """Classes of all objects, room after room."""
        self._shape, self._parts_file = shape, folder / f"lifted_parts_{split}.npz"
        inputs = [*zip(rooms, checksums, chosen, strict=True)]
        self._key = _key_of(inputs, shape)
        tasks = {}
        for path in dict.fromkeys(paths):
            own = [given for given, found in zip(inputs, paths, strict=True) if found == path]
            tasks[str(path)] = (path, _key_of(own, shape), [part for *_, part in own], shape)
        whole = folder / f"lifted_{split}.npz"
        found = _cached(
            whole,
            self._key,
            lambda: _joined(run_tasks(_lift_shard, tasks, "lifting objects from masks")),
        )
        if whole.is_file():
            for path, *_ in tasks.values():
                _part_of(path).unlink(missing_ok=True)
        self.boxes = LiftedBoxes(*(found[name] for name in LiftedBoxes._fields))
        """Boxes of all objects, room after room."""
        self.rays = RayPool(*(found[name] for name in RayPool._fields))
        """Rays around the masks of all objects, room after room."""
        self.walls = [
            [Wall(row[:2], row[2:4], row[4:6], float(row[6])) for row in part]
            for part in np.split(found["walls"], np.cumsum(found["wall_counts"])[:-1])
        ]
        """Walls of each room; none if its shard has no stuff."""
        self._bits = found["bits"]
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
            object_class=self._padded(self.object_classes),
            is_object=self._padded(np.ones(len(self.object_classes), dtype=bool)),
            is_lifted=self._padded(self.boxes.explained > 0),
            boxes_m=self._padded(np.hstack(self.boxes[:2]).astype(np.float32)),
            looks=self._padded(np.full(len(self.object_classes), -1), -1),
        )

    def _padded(self, values: np.ndarray, value: int = 0) -> Tensor:
        """An array of all objects as one tensor by room."""
        parts = torch.from_numpy(values).split(self.counts)
        return pad_sequence(list(parts), batch_first=True, padding_value=value)

    @property
    def usable(self) -> Bool[np.ndarray, " objects"]:
        """True for objects with a label and a lifted box, and so a shape; room after room."""
        return (self.boxes.explained > 0) & (self.object_classes != VOID)

    @property
    def sizes_m(self) -> Float[np.ndarray, "objects 3"]:
        """Full extents, room after room; 1 m for objects that are not usable."""
        return np.where(self.usable[:, None], self.boxes.sizes_m, 1.0)

    def hulls(self) -> Bool[np.ndarray, "objects x y z"]:
        """The visual hulls of all objects, room after room; see `lift_shapes`."""
        cells = self._shape.cells
        flat = np.unpackbits(self._bits, axis=1, count=cells**3).view(bool)
        return flat.reshape(-1, cells, cells, cells)

    def find_prototypes(self, most: int) -> Prototypes:
        """Choose at most `most` prototypes, made of parts, that represent all usable objects."""
        hulls, sizes_m, labels = self.hulls(), self.sizes_m, self.object_classes
        items, common = choose_prototypes(hulls, sizes_m, labels, self.usable, most)
        hangs = self.boxes.centers_m[:, 1] - self.boxes.sizes_m[:, 1] / 2 > HANGS_M

        def fit() -> dict[str, np.ndarray]:
            # Imported only where something is lifted, here and below: Numba is slow to import.
            from sceneprior.lifted.lifting.prototype_fitting import fit_prototypes

            found = fit_prototypes(
                items, hulls, self.rays, sizes_m, labels, self.usable, hangs, self._shape.margin
            )
            counts = np.array([(len(each.kind), len(each.outline)) for each in found])
            return _joined(each._asdict() for each in found) | {"counts": counts}

        chosen = hashlib.sha256(items.tobytes()).hexdigest()
        saved = _cached(self._parts_file, f"{self._key} {PARTS_VERSION} {chosen}", fit)
        solids, corners = np.cumsum(saved["counts"], axis=0)[:-1].T
        columns = [
            np.split(saved[name], corners if name == "outline" else solids)
            for name in Parts._fields
        ]
        parts = tuple(Parts(*each) for each in zip(*columns, strict=True))
        grids = [filled_cells(each, self._shape.cells, self._shape.margin) for each in parts]
        return Prototypes(parts, np.stack(grids), sizes_m[items], labels[items], common)

    def posed_prototypes(
        self, prototypes: Prototypes
    ) -> tuple[Int[np.ndarray, " objects"], Float[np.ndarray, "objects poses"]]:
        """The look of each object, -1 if it is not usable or its class has no prototype; and the
        error of its prototype in each pose (`explain_rays`)."""
        from sceneprior.lifted.lifting.prototype_fitting import explain_rays

        looks, errors = explain_rays(
            prototypes, self.rays, self.sizes_m, self.object_classes, self._shape.margin
        )
        return np.where(self.usable, looks, -1), errors

    def assign_prototypes(self, prototypes: Prototypes) -> None:
        """Assign a look to every object; no object has one before this.

        The prototypes should come from the checkpoint, if there is one: recomputed on another
        processor, they may differ.
        """
        looks = self._padded(self.posed_prototypes(prototypes)[0], -1)
        self._rooms = replace(self._rooms, looks=looks.to(self._rooms.is_object.device))

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
        turned = turn_posed(batch.looks.clamp(min=0), quarters, torch.zeros_like(shown))
        return LiftedRooms(
            room_index=rows,
            object_class=(batch.object_class * is_object)[:, :widest],
            is_object=is_object[:, :widest],
            is_lifted=(batch.is_lifted & is_object)[:, :widest],
            boxes_m=turn_boxes(batch.boxes_m, quarters)[:, :widest],
            looks=turned.where(batch.looks >= 0, -1)[:, :widest],
            room_ids=tuple(self.plain_ids[row // self.rotations] for row, _ in draws),
        )


def _lift_shard(
    path: Path, key: str, chosen: Sequence[np.ndarray], shape: ShapeGrid
) -> dict[str, np.ndarray]:
    """The fields of `LiftedBoxes` and of a `RayPool` of all objects of a shard, their visual hulls
    (`bits`, eight cells per byte), and the rooms' walls, from the `chosen` views of each room."""

    def lift() -> dict[str, np.ndarray]:
        with Shard(path) as shard:
            rooms = zip(shard.room_ids, chosen, strict=True)
            return _joined(_lift_room(shard, *room, shape) for room in rooms)

    return _cached(_part_of(path), key, lift)


def _part_of(shard: Path) -> Path:
    return shard.with_suffix(".lifted.npz")


def _lift_room(
    shard: Shard, room_id: str, views: Int[np.ndarray, " views"], shape: ShapeGrid
) -> dict[str, np.ndarray]:
    from sceneprior.lifted.lifting.boxes import draw_rays, lift_boxes
    from sceneprior.lifted.lifting.hidden_sides import planes_of
    from sceneprior.lifted.lifting.hulls import lift_shapes

    room = shard.read_room(room_id, images=True)
    has_stuff = shard.has_stuff(room_id)
    walls = find_walls(room, views)[0] if has_stuff else ()
    ceiling_m = find_ceiling(room, walls, views) if has_stuff else None
    # Half of the views suffice, and take half the time.
    tops = () if ceiling_m is None else find_walls(room, views[::2], ceiling_m)[0]
    planes = planes_of([*walls, *tops], ceiling_m)
    allowed = np.isin(np.arange(len(room.visible)), views)
    room = replace(room, visible=room.visible & allowed[:, None])
    boxes = lift_boxes(room, planes)
    hulls = lift_shapes(room, boxes, shape).reshape(-1, shape.cells**3)
    rays = draw_rays(room, boxes, RAYS_KEPT, shape.margin)
    half = {name: getattr(rays, name).astype(np.float16) for name in ("starts", "spans")}
    return boxes._asdict() | half | {
        "hits": rays.hits,
        "bits": np.packbits(hulls, axis=1),
        "walls": np.array([np.hstack(wall) for wall in walls]).reshape(-1, 7),
        "wall_counts": np.array([len(walls)]),
    }  # fmt: skip


def _cached(
    path: Path, key: str, find: Callable[[], dict[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Read the arrays cached in a file under this key. If they are missing, compute them, and cache
    them if the file is writable."""
    saved = kept_arrays(path)
    if str(saved.pop("key", None)) == key:
        return saved
    found = find()
    if path.parent.is_dir():  # no folder is created
        with contextlib.suppress(OSError):  # a read-only folder gets no cache
            keep_arrays(path, {"key": np.array(key), **found})
    return found


def _key_of(rooms: Iterable[tuple[RoomViews, str | None, np.ndarray]], shape: ShapeGrid) -> str:
    """Key of everything from which boxes and shapes are computed: rooms, their checksums and chosen
    views. A checksum covers a room's images; for old shards without checksums, measurements taken
    from the images replace it."""
    summary = hashlib.sha256(b"lifted 2")
    for room, checksum, views in rooms:
        summary.update(f"{room.room_id} {checksum}".encode())
        for array in (
            room.object_class, room.boxes, room.mask_pixels, room.sides_clear,
            room.world_to_camera, room.intrinsics, views,
        ):  # fmt: skip
            summary.update(np.ascontiguousarray(array).data)
    return f"{summary.hexdigest()} {VERSION} {shape.cells} {shape.margin}"


def _joined(items: Iterable[dict[str, Any]]) -> dict[str, np.ndarray]:
    """Arrays of the same names, concatenated."""
    items = list(items)
    return {name: np.concatenate([each[name] for each in items]) for name in items[0]}
