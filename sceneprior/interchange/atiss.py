"""Export in ATISS's format: one box list per room, which `box_lists.py` reads back."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely

from sceneprior.core.classes import label_set
from sceneprior.core.files import write_whole
from sceneprior.core.outline import floor_polygon
from sceneprior.core.scene import Scene, Turned
from sceneprior.interchange.box_lists import NOT_FURNITURE

ENDS = ("start", "end")
"""Columns that ATISS appends to the class columns."""


def write_atiss(scenes: Sequence[Scene], folder: Path) -> None:
    """Write `<room>/boxes.npz` for each room, y up, in metres, with the floor's centre as origin.

    Sizes are half extents in the box's own frame. An object with a turned box is written with that
    box; any other object with its axis-aligned box and angle 0. Meshes are not written. The columns
    of `class_labels` are the label set without void, then `start` and `end`.
    """
    for scene in scenes:
        columns = [name for name in label_set(scene.label_set) if name not in NOT_FURNITURE]
        one_hot = np.eye(len(columns) + len(ENDS), dtype=np.float32)
        rows = [columns.index(item.label) for item in scene.objects]
        boxes = [item.turned or Turned(0.0, item.size_m) for item in scene.objects]
        outline = floor_polygon(scene)
        floor: dict[str, Any] = {} if outline is None else floor_plan(outline)
        buffer = io.BytesIO()
        np.savez(
            buffer,
            class_labels=one_hot[np.array(rows, dtype=int)],
            translations=scene.centers_m,
            sizes=np.array([box.size_m for box in boxes]).reshape(-1, 3) / 2,
            angles=np.array([box.yaw_rad for box in boxes]).reshape(-1, 1),
            **floor,
        )
        write_whole(Path(folder) / scene.name / "boxes.npz", buffer.getvalue())


def floor_plan(floor: shapely.Geometry) -> dict[str, np.ndarray]:
    """Convert a floor polygon to ATISS's arrays: triangles at y = 0 that face up, and the origin as
    centroid.

    >>> floor_plan(shapely.box(-1, -1, 1, 1))["floor_plan_faces"].shape
    (2, 3)
    """
    # A polygon with repeated corners cannot be triangulated.
    floor = shapely.remove_repeated_points(floor)
    parts = shapely.get_parts(shapely.constrained_delaunay_triangles(floor))
    # Counter-clockwise in (x, z) faces down with y up, so the order is reversed.
    corners = [np.asarray(shapely.orient_polygons(part).exterior.coords)[2::-1] for part in parts]
    flat = np.concatenate(corners)
    return {
        "floor_plan_vertices": np.stack([flat[:, 0], np.zeros(len(flat)), flat[:, 1]], axis=1),
        "floor_plan_faces": np.arange(len(flat)).reshape(-1, 3),
        "floor_plan_centroid": np.zeros(3),
    }
