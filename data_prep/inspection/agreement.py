"""How well the ground truth in 3D, projected, agrees with the masks in 2D."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import trimesh
from cachetools import LRUCache, cachedmethod

from data_prep.inspection.projection import box_iou_2d, boxes_around
from sceneprior.errors import ShardError
from sceneprior.geometry.corners import box_corners
from sceneprior.shards import RoomGroundTruth, RoomViews

_MODEL_BYTES = 256 << 20
_BOX_SLACK_M = 0.005
"""The stored box against the placed mesh: vertices are float32 in metres."""


class ModelPoints:
    """The vertices of `models/<id>.ply` in a folder of shards, the last used ones kept."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self._cache: LRUCache[str, np.ndarray] = LRUCache(
            _MODEL_BYTES, lambda points: points.nbytes
        )

    @cachedmethod(lambda self: self._cache, key=lambda self, model_id: model_id)
    def get(self, model_id: str) -> np.ndarray:
        """(V, 3) float64, only vertices that a face uses.

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
        return points


@dataclass(frozen=True)
class Agreement:
    """Overlap of the box round the projected ground truth with the mask's box, by what stands for
    the object: its mesh, or, where the data set has none, its 3D box."""

    mesh: list[float] = field(default_factory=list)
    """IoU of each unoccluded object in each view; 0 where part of it lies behind the camera."""
    box: list[float] = field(default_factory=list)

    @property
    def means(self) -> dict[str, float]:
        """`mesh` and `box`, each where it was measured."""
        kinds = {"mesh": self.mesh, "box": self.box}
        return {kind: float(np.mean(values)) for kind, values in kinds.items() if values}

    def __add__(self, other: "Agreement") -> "Agreement":
        return Agreement(self.mesh + other.mesh, self.box + other.box)


def unoccluded(views: RoomViews) -> np.ndarray:
    """(T, n) bool: all of the object is seen, so its mask's box is its own.

    No other object touches a side of its box, and the box keeps away from the image's border.
    """
    height, width = views.image_size
    pixels = views.boxes * np.array([width, height, width, height], dtype=np.float32)
    inside = (pixels[..., :2] > 0.5).all(-1) & (
        pixels[..., 2:] < np.array([width, height]) - 0.5
    ).all(-1)
    return views.visible & views.sides_clear.all(-1) & inside


def measure(
    views: RoomViews, truth: RoomGroundTruth, models: ModelPoints
) -> tuple[Agreement, list[str]]:
    """Project every object's ground truth into the views that see all of it.

    Returns:
        The overlaps, and what is wrong with the ground truth itself, as sentences.
    """
    problems: list[str] = []
    agreement = Agreement()
    seen, height_width = unoccluded(views), views.image_size
    scale = np.array([height_width[1], height_width[0]] * 2, dtype=np.float64)
    for k, model_id in enumerate(truth.model_ids):
        points = box_corners(truth.centers_m[k], truth.sizes_m[k])
        if model_id:
            try:
                points = placed(models.get(model_id), truth.model_to_room[k])
            except ShardError as error:
                problems.append(str(error).removesuffix("."))
                continue
            problems += _box_problem(k, points, truth)
        if k >= len(views.object_class) or not seen[:, k].any():
            continue
        chosen = np.flatnonzero(seen[:, k])
        boxes = boxes_around(points, views.world_to_camera[chosen], views.intrinsics[chosen])
        # All of the object is seen, so an overlap that is undefined (behind the camera) is a miss.
        overlap = np.nan_to_num(box_iou_2d(boxes, views.boxes[chosen, k] * scale))
        (agreement.mesh if model_id else agreement.box).extend(overlap.tolist())
    return agreement, problems


def _inverse(poses: np.ndarray) -> np.ndarray:
    """Of rigid transforms, (T, 4, 4)."""
    inverse = poses.copy()
    inverse[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    inverse[:, :3, 3:] = -inverse[:, :3, :3] @ poses[:, :3, 3:]
    return inverse


_OPENGL_AXES = np.diag(np.array([1, -1, -1, 1], dtype=np.float32))
CAMERA_REPAIRS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "world_to_camera seems to hold camera-to-world matrices; inverted": _inverse,
    "the cameras seem to have OpenGL axes (y up, z backward) instead of OpenCV's; with y and z "
    "flipped": lambda poses: _OPENGL_AXES @ poses,
    "world_to_camera seems to hold camera-to-world matrices with OpenGL axes; inverted, and with "
    "y and z flipped": lambda poses: _OPENGL_AXES @ _inverse(poses),
}
"""What is often wrong with given poses, as a sentence up to the overlap -> the right poses."""


def measure_repaired(
    views: RoomViews, truth: RoomGroundTruth, models: ModelPoints
) -> dict[str, Agreement]:
    """The agreement that each of `CAMERA_REPAIRS` would give."""
    return {
        cause: measure(
            replace(views, world_to_camera=repair(views.world_to_camera)), truth, models
        )[0]
        for cause, repair in CAMERA_REPAIRS.items()
    }


def placed(points: np.ndarray, model_to_room: np.ndarray) -> np.ndarray:
    """A model's points where the piece stands, (V, 3) float64 in the room frame."""
    matrix = np.asarray(model_to_room, dtype=np.float64)
    return points @ matrix[:3, :3].T + matrix[:3, 3]


def _box_problem(k: int, points: np.ndarray, truth: RoomGroundTruth) -> Sequence[str]:
    half = truth.sizes_m[k].astype(np.float64) / 2
    stored = np.stack([truth.centers_m[k] - half, truth.centers_m[k] + half])
    off = np.abs(stored - np.stack([points.min(axis=0), points.max(axis=0)])).max()
    if off <= _BOX_SLACK_M + 1e-5 * np.abs(stored).max():
        return ()
    return (f"the 3D box of object {k} is {off:.3f} m off the box round its placed mesh",)
