"""Boxes, shapes, walls and parts lifted from masks, cached as files beside the shards.

A file is found again when its inputs or its version changes, and is left out if the folder is not
writable.
"""

import contextlib
import hashlib
import io
import zipfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Int
from rich.console import Console
from rich.progress import track

from sceneprior.core.files import write_whole
from sceneprior.core.observations import RoomViews
from sceneprior.core.parts import Parts
from sceneprior.core.shards import Shard, iterate_rooms
from sceneprior.core.wall_lines import Wall, find_walls
from sceneprior.lifted.lifting import LiftedBoxes, ShapeGrid

VERSION = 2
"""Version of the cached boxes."""
SHAPES_VERSION = 5
"""Version of the cached hulls and rays. Increase a version when results change."""
PARTS_VERSION = 1
"""Version of the cached parts: increase it when `prototype_fitting.py`, `part_fit.py` and what it
imports, `ALIKE` or `HANGS_M` change; delete `lifted_parts_*.npz` while trying settings."""
WALLS_VERSION = 1
"""Version of the cached walls."""

RAYS_KEPT = 1024
"""Number of rays per object from which its shape is found."""


class LiftedCache(NamedTuple):
    """Boxes, shapes, parts and walls of a split: lifted from masks once, then read from files."""

    folder: Path
    """Folder of the shards."""
    split: str
    chosen: Sequence[Int[np.ndarray, " views"]]
    """The views to use, for each room of the split."""
    key: str
    """Hash of the input (`fingerprint`)."""

    def boxes(self, counts: Sequence[int]) -> list[LiftedBoxes]:
        """Boxes of each room, which has `counts` objects."""

        def find() -> dict[str, np.ndarray]:
            from sceneprior.lifted.lifting.boxes import lift_boxes

            return _joined(
                lift_boxes(shard.read_room(room_id, images=True), views)
                for views, shard, room_id in self._rooms("lifting boxes from masks (rooms)")
            )

        saved = self._kept("lifted", self.key, find)
        rooms = [np.split(saved[name], np.cumsum(counts)[:-1]) for name in LiftedBoxes._fields]
        return [LiftedBoxes(*each) for each in zip(*rooms, strict=True)]

    def shapes(self, boxes: Sequence[LiftedBoxes], grid: ShapeGrid) -> dict[str, np.ndarray]:
        """Visual hulls (`bits`), packed to eight cells per byte, and the fields of a `RayPool`, of
        all objects, whose boxes are given by room."""

        def find() -> dict[str, np.ndarray]:
            from sceneprior.lifted.lifting.boxes import draw_rays
            from sceneprior.lifted.lifting.hulls import lift_shapes

            hulls, rays = [], []
            for its_boxes, (views, shard, room_id) in zip(
                boxes, self._rooms("lifting shapes from masks (rooms)"), strict=True
            ):
                room = shard.read_room(room_id, images=True)
                hulls.append(lift_shapes(room, its_boxes, grid, views))
                rays.append(draw_rays(room, its_boxes, RAYS_KEPT, grid.margin, views))
            grids, found = np.concatenate(hulls), _joined(rays)
            found |= {name: found[name].astype(np.float16) for name in ("starts", "spans")}
            return found | {"bits": np.packbits(grids.reshape(len(grids), -1), axis=1)}

        return self._kept("lifted_shapes", self._shapes_key(grid), find)

    def parts(
        self,
        items: Int[np.ndarray, " prototypes"],
        grid: ShapeGrid,
        fit: Callable[[], tuple[Parts, ...]],
    ) -> tuple[Parts, ...]:
        """Parts of the prototypes, which are the objects `items`; `fit` finds them."""

        def find() -> dict[str, np.ndarray]:
            found = fit()
            counts = np.array([(len(each.kind), len(each.outline)) for each in found])
            return _joined(found) | {"counts": counts}

        chosen = hashlib.sha256(items.tobytes()).hexdigest()
        key = f"{self._shapes_key(grid)} {PARTS_VERSION} {chosen}"
        saved = self._kept("lifted_parts", key, find)
        solids, corners = np.cumsum(saved["counts"], axis=0)[:-1].T
        columns = [
            np.split(saved[name], corners if name == "outline" else solids)
            for name in Parts._fields
        ]
        return tuple(Parts(*each) for each in zip(*columns, strict=True))

    def walls(self) -> list[list[Wall]]:
        """Walls of each room; none if its shard has no stuff."""

        def find() -> dict[str, np.ndarray]:
            found = [
                find_walls(shard.read_room(room_id, images=True), views)[0]
                if shard.has_stuff(room_id)
                else ()
                for views, shard, room_id in self._rooms("finding walls in masks (rooms)")
            ]
            rows = [np.hstack(wall) for walls in found for wall in walls]
            return {
                "walls": np.array(rows).reshape(-1, 7),
                "counts": np.array([len(walls) for walls in found]),
            }

        saved = self._kept("lifted_walls", f"{self.key} {WALLS_VERSION}", find)
        return [
            [Wall(row[:2], row[2:4], row[4:6], float(row[6])) for row in part]
            for part in np.split(saved["walls"], np.cumsum(saved["counts"])[:-1])
        ]

    def _shapes_key(self, grid: ShapeGrid) -> str:
        return f"{self.key} {SHAPES_VERSION} {grid.cells} {grid.margin}"

    def _rooms(self, words: str) -> Iterator[tuple[np.ndarray, Shard, str]]:
        """The chosen views, shard and id of each room, with a progress bar called `words`."""
        rooms = iterate_rooms(self.folder, self.split)
        progress = track(self.chosen, words, console=Console(stderr=True))
        for views, (shard, room_id) in zip(progress, rooms, strict=True):
            yield views, shard, room_id

    def _kept(
        self, name: str, key: str, find: Callable[[], dict[str, np.ndarray]]
    ) -> dict[str, np.ndarray]:
        """Read the arrays cached in a file under this key. If they are missing, compute them, and
        cache them if the file is writable."""
        path = self.folder / f"{name}_{self.split}.npz"
        try:
            with np.load(path) as saved:
                if str(saved["key"]) == key:
                    return {name: saved[name] for name in saved.files}
        except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile):
            pass  # missing or damaged: computed again
        found = find()
        buffer = io.BytesIO()
        np.savez(buffer, allow_pickle=False, key=np.array(key), **found)
        if path.parent.is_dir():  # no folder is created
            with contextlib.suppress(OSError):  # a read-only folder gets no cache
                write_whole(path, buffer.getvalue())
        return found


def fingerprint(
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


def _joined(items: Any) -> dict[str, np.ndarray]:
    """The fields of named tuples of arrays, each concatenated."""
    items = list(items)
    columns = zip(*items, strict=True)
    return {
        name: np.concatenate(column) for name, column in zip(items[0]._fields, columns, strict=True)
    }
