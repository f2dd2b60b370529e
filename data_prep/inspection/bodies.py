"""What stands for each object of a room in 3D: its mesh, its 3D box, or a box found from masks."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from cachetools import LRUCache, cachedmethod

from data_prep.inspection.projection import Hull, hull_of
from data_prep.upright import fit_upright
from sceneprior.errors import ShardError
from sceneprior.geometry.corners import BOX_EDGES, box_corners
from sceneprior.shards import RoomGroundTruth, RoomViews

KINDS = {"mesh": "meshes", "box": "3D boxes", "found": "boxes found from the masks"}
"""What stands for an object -> in words."""
_MODEL_BYTES = 256 << 20
_BOX_SLACK_M = 0.005
"""The stored box against the placed mesh: vertices are float32 in metres."""


class Body(NamedTuple):
    """An object in the room frame."""

    kind: str
    """A key of `KINDS`."""
    hull: Hull


class ModelHulls:
    """The convex hulls of `models/<id>.ply` in a folder of shards, the last used ones kept."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self._cache: LRUCache[str, Hull] = LRUCache(
            _MODEL_BYTES, lambda hull: hull.points_m.nbytes + hull.edges.nbytes
        )

    @cachedmethod(lambda self: self._cache, key=lambda self, model_id: model_id)
    def get(self, model_id: str) -> Hull:
        """In the model's frame, of vertices that a face uses.

        Raises:
            ShardError: the file is missing or damaged.
        """
        path = self.folder / f"{model_id}.ply"
        try:
            mesh = trimesh.load_mesh(path, process=False)
            points = np.asarray(mesh.vertices, dtype=np.float64)[np.unique(mesh.faces)]
        except Exception as error:  # what trimesh raises depends on which byte is damaged
            why = "is missing" if not path.is_file() else f"is damaged ({type(error).__name__})"
            raise ShardError(f"{path} {why}, but ground truth stands on it.") from None
        if not len(points) or not np.isfinite(points).all():
            raise ShardError(f"{path} holds no usable faces, but ground truth stands on it.")
        return hull_of(points)


def true_bodies(
    views: RoomViews, truth: RoomGroundTruth, models: ModelHulls
) -> tuple[list[Body | None], list[str]]:
    """The tracked objects as the ground truth has them, None where it cannot be read, and what is
    wrong with the ground truth itself, as sentences."""
    bodies: list[Body | None] = []
    problems: list[str] = []
    for k, model_id in enumerate(truth.model_ids):
        corners = box_corners(truth.centers_m[k], truth.sizes_m[k]).astype(np.float64)
        body: Body | None = Body("box", Hull(corners, np.array(BOX_EDGES)))
        if model_id:
            try:
                body = Body("mesh", _placed(models.get(model_id), truth.model_to_room[k]))
                problems += _box_problem(k, body.hull.points_m, truth)
            except ShardError as error:
                body = None
                problems.append(str(error).removesuffix("."))
        bodies.append(body)
    return bodies[: len(views.object_class)], problems


def found_bodies(views: RoomViews) -> list[Body | None]:
    """Upright boxes found from the masks alone; None where the views do not tell."""
    found = fit_upright(views, views.image_size, views.world_to_camera, views.intrinsics)
    return [
        Body("found", Hull(corners, np.array(BOX_EDGES))) if np.isfinite(corners).all() else None
        for corners in found.corners_m
    ]


def _placed(hull: Hull, model_to_room: np.ndarray) -> Hull:
    """A model's hull where the piece stands."""
    matrix = np.asarray(model_to_room, dtype=np.float64)
    return hull._replace(points_m=hull.points_m @ matrix[:3, :3].T + matrix[:3, 3])


def _box_problem(k: int, points: np.ndarray, truth: RoomGroundTruth) -> list[str]:
    half = truth.sizes_m[k].astype(np.float64) / 2
    stored = np.stack([truth.centers_m[k] - half, truth.centers_m[k] + half])
    off = np.abs(stored - np.stack([points.min(axis=0), points.max(axis=0)])).max()
    if off <= _BOX_SLACK_M + 1e-5 * np.abs(stored).max():
        return []
    return [f"the 3D box of object {k} is {off:.3f} m off the box round its placed mesh"]
