"""SceneEval's opening clearance: doors and windows with no object in front of them."""

from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.outline import floor_polygon
from sceneprior.core.scene import Opening, Scene
from sceneprior.evaluation.metric import USED, Counts, Metric
from sceneprior.evaluation.surfaces import Triangles, own_box, triangles_of

BEFORE_WINDOW_M = 0.5
"""Depth of the space in front of a window; in front of a door, it is the door's width."""
TEST_M = 0.1
"""Distance from an opening at which a point is tested for being in the room."""
PIXELS_PER_M = 100
POINTS_PER_M3, FEWEST_POINTS = 5000, 64
"""Test points per cubic metre of an object's box, and their minimum number."""
TOLERANCE_M = 1e-6


class Clearance(NamedTuple):
    """Result for an opening: if an object stands in front of it, and the share of its area
    covered."""

    blocked: bool
    covered: float


def clearances(scene: Scene) -> list[Clearance]:
    """Test the space in front of each door and window, inside the room.

    The space is as wide and high as the opening. Its depth is the door's width, or 0.5 m for a
    window. An object reaches into the space if one of the random points in its box does (5,000 per
    cubic metre, at least 64). The triangles of such objects that lie at least partly within the
    space's depth are projected onto the opening, on a grid of 100 pixels per metre. The opening is
    blocked if there are such triangles, and `covered` is the share of its pixels that they cover.
    An opening with the room on neither side has no entry.

    Source:
        3dlg-hcvc/SceneEval, metrics/opening_clearance.py, with its default settings: only the side
        in the room. SceneEval's openings are 1 mm thick, which adds 0.5 mm to the depth; here they
        have no thickness.
    """
    floor = floor_polygon(scene)
    if floor is None or not scene.openings:
        return []
    draws = np.random.default_rng(0)
    points = []
    for item in scene.objects:
        yaw_rad, size_m, _ = own_box(item)
        count = max(int(np.prod(size_m) * POINTS_PER_M3), FEWEST_POINTS)
        inner = draws.uniform(-0.5, 0.5, (count, 3)) * np.asarray(size_m)
        points.append(inner @ yaw_rotation(yaw_rad).T + np.asarray(item.center_m))
    surfaces = [triangles_of(item) for item in scene.objects]
    found = []
    for opening in scene.openings:
        frame = _Frame.of(opening, floor)
        if frame is not None:
            before = [
                surface
                for surface, inner in zip(surfaces, points, strict=True)
                if frame.holds(inner)
            ]
            found.append(frame.clearance(before))
    return found


class _Frame(NamedTuple):
    """Coordinate frame of an opening: along it, above its lower edge, and into the room."""

    origin_m: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    size_m: Float[np.ndarray, "3"]

    @classmethod
    def of(cls, opening: Opening, floor: shapely.Geometry) -> "_Frame | None":
        start, end = (
            np.array([x, opening.bottom_m, z]) for x, z in (opening.start_m, opening.end_m)
        )
        width = float(np.linalg.norm(end - start))
        along = (end - start) / width
        for inward in (np.cross(along, [0.0, 1.0, 0.0]), np.cross([0.0, 1.0, 0.0], along)):
            tested = (start + end) / 2 + TEST_M * inward
            if shapely.contains_xy(floor, tested[0], tested[2]):
                depth = width if opening.kind == "door" else BEFORE_WINDOW_M
                height = opening.top_m - opening.bottom_m
                axes = np.array([along, [0.0, 1.0, 0.0], inward])
                return cls(start, axes, np.array([width, height, depth]))
        return None

    def holds(self, points: np.ndarray) -> bool:
        local = (points - self.origin_m) @ self.axes.T
        inside = (local >= -TOLERANCE_M) & (local <= self.size_m + TOLERANCE_M)
        return bool(inside.all(axis=1).any())

    def clearance(self, surfaces: list[Triangles]) -> Clearance:
        import cv2

        width, height, depth = self.size_m
        shape = (int(np.ceil(height * PIXELS_PER_M)), int(np.ceil(width * PIXELS_PER_M)))
        covered = np.zeros(shape, dtype=np.uint8)
        blocked = False
        for surface in surfaces:
            local = (surface - self.origin_m) @ self.axes.T
            reaching = (local[:, :, 2].min(axis=1) <= depth) & (local[:, :, 2].max(axis=1) >= 0)
            blocked |= bool(reaching.any())
            for triangle in local[reaching]:
                pixels = np.stack([triangle[:, 0], height - triangle[:, 1]], axis=1) * PIXELS_PER_M
                cv2.fillConvexPoly(covered, pixels.astype(np.int32), 1)
        return Clearance(blocked, float(covered.mean()) if blocked else 0.0)


def _clearance(scene: Scene) -> Counts:
    found = clearances(scene)
    return {
        "sceneeval_clear_openings": (float(sum(not o.blocked for o in found)), len(found)),
        "sceneeval_covered_openings": (float(sum(o.covered for o in found)), len(found)),
    }


METRICS = (
    Metric(
        "sceneeval_clear_openings", "Doors and windows with nothing before them (SceneEval)",
        "share; known openings only", "higher", _clearance, USED,
    ),
    Metric(
        "sceneeval_covered_openings", "Area of doors and windows that is covered (SceneEval)",
        "share; known openings only", "lower", _clearance, USED,
    ),
)  # fmt: skip
