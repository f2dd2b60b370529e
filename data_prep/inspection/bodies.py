"""3D representation of each object of a room's ground truth: its mesh, or its 3D box."""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from data_prep.inspection.projection import Hull, hull_of
from sceneprior.core.errors import ShardError
from sceneprior.core.geometry.corners import BOX_EDGES, box_corners
from sceneprior.core.ground_truth import load_model, model_path
from sceneprior.core.shards import RoomGroundTruth, RoomViews

KINDS = {"mesh": "meshes", "box": "3D boxes"}
"""Names of the types of 3D representations, for messages."""
_BOX_SLACK_M = 0.005
"""Tolerance between the stored box and the placed mesh, whose vertices are float32."""


class Body(NamedTuple):
    """An object in the room frame."""

    kind: str
    """A key of `KINDS`."""
    hull: Hull
    unoccluded: np.ndarray | None = None
    """(T,) bool, as in `RoomGroundTruth`; None if only tracked objects can occlude it."""


@lru_cache(maxsize=4096)
def hull_of_model(path: Path) -> Hull:
    """Convex hull of a model (`model_path`) in its own frame; the file is read once."""
    return hull_of(load_model(path).vertices_m)


def true_bodies(
    views: RoomViews, truth: RoomGroundTruth, shards: Path
) -> tuple[list[Body | None], list[str]]:
    """Tracked objects according to the ground truth, and faults of the ground truth as sentences.

    Objects whose model cannot be read are None.
    """
    bodies: list[Body | None] = []
    problems: list[str] = []
    for k, model_id in enumerate(truth.model_ids):
        corners = box_corners(truth.centers_m[k], truth.sizes_m[k]).astype(np.float64)
        body: Body | None = Body("box", Hull(corners, np.array(BOX_EDGES)))
        if model_id:
            try:
                hull = hull_of_model(model_path(shards, model_id))
                body = Body("mesh", _placed(hull, truth.model_to_room[k]))
                problems += _box_problem(k, body.hull.points_m, truth)
            except ShardError as error:
                body = None
                problems.append(str(error).removesuffix("."))
        if body is not None and truth.unoccluded is not None and k < truth.unoccluded.shape[1]:
            body = body._replace(unoccluded=truth.unoccluded[:, k])
        bodies.append(body)
    return bodies[: len(views.object_class)], problems


def _placed(hull: Hull, model_to_room: np.ndarray) -> Hull:
    """Transform a model's hull to the room frame."""
    matrix = np.asarray(model_to_room, dtype=np.float64)
    return hull._replace(points_m=hull.points_m @ matrix[:3, :3].T + matrix[:3, 3])


def _box_problem(k: int, points: np.ndarray, truth: RoomGroundTruth) -> list[str]:
    half = truth.sizes_m[k].astype(np.float64) / 2
    stored = np.stack([truth.centers_m[k] - half, truth.centers_m[k] + half])
    off = np.abs(stored - np.stack([points.min(axis=0), points.max(axis=0)])).max()
    if off <= _BOX_SLACK_M + 1e-5 * np.abs(stored).max():
        return []
    return [f"the 3D box of object {k} differs by {off:.3f} m from the box around its placed mesh"]
