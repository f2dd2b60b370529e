"""Write rooms as ATISS keeps them: one box list a room, which `box_lists.py` reads back."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from sceneprior.classes import label_set
from sceneprior.files import write_whole
from sceneprior.interchange.box_lists import NOT_FURNITURE
from sceneprior.scene import Scene

ENDS = ("start", "end")
"""Columns that ATISS keeps beside the classes, after them."""


def write_atiss(scenes: Sequence[Scene], folder: Path) -> None:
    """Write `<room>/boxes.npz` for each room, y up, in metres, about the floor's centre.

    Boxes are axis-aligned, so every angle is 0 and sizes are half extents along x, y, z; meshes
    are left behind. Columns of `class_labels` are the label set without void, then start and end.
    """
    for scene in scenes:
        columns = [name for name in label_set(scene.label_set) if name not in NOT_FURNITURE]
        one_hot = np.eye(len(columns) + len(ENDS), dtype=np.float32)
        rows = [columns.index(item.label) for item in scene.objects]
        floor: dict[str, Any] = {} if scene.floor_m is None else floor_plan(scene.floor_m)
        buffer = io.BytesIO()
        np.savez(
            buffer,
            class_labels=one_hot[np.array(rows, dtype=int)],
            translations=scene.centers_m,
            sizes=scene.sizes_m / 2,
            angles=np.zeros((len(rows), 1)),
            **floor,
        )
        write_whole(Path(folder) / scene.name / "boxes.npz", buffer.getvalue())


def floor_plan(outline_m: np.ndarray) -> dict[str, np.ndarray]:
    """A floor as triangles (facing up) at y = 0, about the origin.

    >>> square = np.array([[-1.0, -1], [1, -1], [1, 1], [-1, 1]])
    >>> floor_plan(square)["floor_plan_faces"].shape
    (2, 3)
    """
    parts = shapely.constrained_delaunay_triangles(shapely.Polygon(outline_m)).geoms
    # Counter-clockwise in (x, z) faces down where y is up: turned about.
    corners = [np.asarray(shapely.orient_polygons(part).exterior.coords)[2::-1] for part in parts]
    flat = np.concatenate(corners)
    return {
        "floor_plan_vertices": np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], axis=1),
        "floor_plan_faces": np.arange(len(flat)).reshape(-1, 3),
        "floor_plan_centroid": np.zeros(3),
    }
