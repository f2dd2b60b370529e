"""Batches of views with true boxes and shapes, for the baselines with 3D supervision.

Only Total3D and Im3D train on them; USL and the paper's method never open them
(tests/baselines/test_true_boxes.py).
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int16
from torch import Tensor

from sceneprior.baselines.true_boxes import check_ground_truth
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.ground_truth import reference_scene
from sceneprior.core.shards import iterate_rooms
from sceneprior.core.surfaces import surface_points
from sceneprior.core.views import SceneViews
from sceneprior.render.appearance import object_mesh

POINTS = 256
"""Number of points sampled on the surface of each object."""
CELLS = 16
"""Cells along each axis of an object's grid."""
DENSE = 12288
"""Number of surface points from which occupied cells are found: about eight per surface cell of a
cube."""


class TrueViews(NamedTuple):
    """Views of rooms with the boxes and shapes of tracked objects; zeros for void and padding."""

    views: SceneViews
    boxes_m: Float[Tensor, "rooms objects 6"]
    """Centre, then full extents, in the room frame."""
    points: Float[Tensor, "rooms objects points 3"]
    """Points on the surface, in the frame in which the object's box is [-1, 1]^3."""
    occupied: Bool[Tensor, "rooms objects x y z"]
    """Cells of the box inside the object."""


class TrueViewDataset(ViewDataset):
    """A `ViewDataset` of unturned rooms with the boxes and shapes of their ground truth."""

    def __init__(self, folder: Path, split: str, **options: Any):
        super().__init__(folder, split, **options)
        true = [_read(folder, shard, room_id) for shard, room_id in iterate_rooms(folder, split)]
        self._true = [
            torch.nn.utils.rnn.pad_sequence([torch.from_numpy(part) for part in parts], True)
            for parts in zip(*true, strict=True)
        ]
        """The fields of `TrueViews` after `views`."""

    def to(self, device: torch.device | str) -> "TrueViewDataset":
        """Move views, boxes and shapes to `device`."""
        super().to(device)
        self._true = [part.to(device) for part in self._true]
        return self

    def log_sizes(self) -> tuple[Float[Tensor, "objects 3"], Int16[Tensor, " objects"]]:
        """Logs of all objects' sizes in metres, and their classes."""
        classes = self.flat.object_class[:-1]  # the last is padding
        boxes_m = self._true[0]
        there = torch.arange(boxes_m.shape[1]) < self.flat.object_count[:, None]
        return boxes_m[there][:, 3:].clamp(min=1e-3).log(), classes

    def __getitems__(self, draws: list[tuple[int, int]]) -> TrueViews:  # type: ignore[override]
        views = super().__getitems__(draws)
        rooms = torch.tensor([row for row, _ in draws], device=views.boxes.device)
        most = views.is_object.shape[1]
        return TrueViews(views, *(part[rooms, :most] for part in self._true))


def _read(folder: Path, shard: Any, room_id: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    check_ground_truth(shard, room_id)
    scene = reference_scene(shard, room_id, folder, tracked_only=True)
    boxes_m = np.hstack([scene.centers_m, scene.sizes_m]).astype(np.float32)
    points = np.empty((len(boxes_m), POINTS, 3), np.float32)
    occupied = np.empty((len(boxes_m), CELLS, CELLS, CELLS), bool)
    for row, item in enumerate(scene.objects):
        mesh, half_m = object_mesh(item), np.maximum(item.size_m, 1e-6) / 2
        # The mesh is scaled to the cube first; otherwise the thin sides of a flat piece would get
        # few points.
        unit = (mesh.vertices_m - np.asarray(item.center_m)) / half_m
        occupied[row] = filled(surface_points(unit, mesh.faces, DENSE), CELLS)
        surface = surface_points(mesh.vertices_m, mesh.faces, POINTS)
        points[row] = (surface - np.asarray(item.center_m)) / half_m
    return boxes_m, points, occupied


def filled(points: Float[np.ndarray, "points 3"], cells: int) -> Bool[np.ndarray, "x y z"]:
    """Cells of [-1, 1]^3 that contain a surface point, or that lie between such cells along all
    three axes.

    A surface cell that happens to contain no point affects at most the lines through it, whereas a
    flood fill would leak there.

    Example: a sphere's inside is filled.

        >>> directions = np.random.default_rng(0).normal(size=(4000, 3))
        >>> sphere = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        >>> grid = filled(sphere, 8)
        >>> bool(grid[4, 4, 4]), bool(grid[0, 0, 0])
        (True, False)
    """
    surface = np.zeros((cells,) * 3, dtype=bool)
    surface[tuple(((points + 1) / 2 * cells).astype(int).clip(0, cells - 1).T)] = True
    between = np.ones_like(surface)
    for axis in range(3):
        between &= np.logical_or.accumulate(surface, axis)
        between &= np.flip(np.logical_or.accumulate(np.flip(surface, axis), axis), axis)
    return surface | between
