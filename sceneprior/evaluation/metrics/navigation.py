"""Free floor on a pixel map, and the space before doors and windows: SceneEval's NAV and opening
clearance, PhyScene's R_out, R_reach and walkable area."""

from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.core.scene import Opening, Scene
from sceneprior.core.shell import floor_polygon
from sceneprior.evaluation.geometry import (
    Points,
    footprint,
    in_own_box,
    point_count,
    triangles_of,
)
from sceneprior.evaluation.metric import USED, Counts, TableColumn, metric

PIXELS = 256
"""Width and height of the floor map in pixels."""
MARGIN_M = 0.2
"""Margin between the floor's farthest corner and the edge of the map, along an axis."""
SCENEEVAL_ROBOT_M, SCENEEVAL_HEIGHT_M = 0.2, 2.0
"""Width of the robot, and height of an object's centre above which the object is no obstacle."""
PHYSCENE_ROBOT_M, PHYSCENE_HEIGHT_M = 0.3, 1.5
BEFORE_WINDOW_M = 0.5
"""Depth of the space in front of a window; in front of a door, it is the door's width."""
TEST_M = 0.1
"""Distance from an opening at which a point is tested for being in the room."""
PIXELS_PER_M = 100
FEWEST_POINTS = 64
TOLERANCE_M = 1e-6


class FloorMap(NamedTuple):
    """Pixel map of a room's floor and objects, for a robot of one width."""

    floor: Bool[np.ndarray, "pixels pixels"]
    boxes: Bool[np.ndarray, "objects pixels pixels"]
    """Pixels of each object's box."""
    grown: Bool[np.ndarray, "objects pixels pixels"]
    """The boxes with a margin of half the robot's width."""
    eroded: Bool[np.ndarray, "pixels pixels"]
    """The floor without a margin of half the robot's width along its edge."""

    def free(self, obstacles: Bool[np.ndarray, " objects"]) -> Int[np.ndarray, "pixels pixels"]:
        """Label the 8-connected areas where the robot's centre can be, from 1; 0 elsewhere."""
        from scipy.ndimage import label

        walkable = self.eroded & ~self.grown[obstacles].any(axis=0)
        areas, _ = label(walkable, structure=np.ones((3, 3), dtype=int))
        return np.asarray(areas, dtype=np.int64)


def floor_map(scene: Scene, robot_m: float) -> FloorMap | None:
    """Draw a room's floor and the boxes of its objects, 256 x 256 pixels; None without a floor.

    The map is centred at the middle of the floor's bounding rectangle; half its width is the
    largest distance to a corner along an axis, plus 0.2 m. The floor is eroded with a square as
    wide as the robot, and each box grows by an outline as wide as the robot.
    """
    import cv2

    if floor_polygon(scene) is None:
        return None
    corners = np.asarray(scene.floor_m, dtype=np.float64)
    middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
    scale = PIXELS / 2 / (np.abs(corners - middle).max() + MARGIN_M)
    width = int(robot_m * scale)

    def drawn(points: np.ndarray, line: int = 0) -> np.ndarray:
        image = np.zeros((PIXELS, PIXELS), dtype=np.uint8)
        pixels = np.trunc((points - middle) * scale).astype(np.int32) + PIXELS // 2
        if line:
            cv2.drawContours(image, [pixels], 0, 1, line)
        return np.asarray(cv2.fillPoly(image, [pixels], 1))

    floor = drawn(corners)
    places = [footprint(item) for item in scene.objects]
    boxes, grown = (
        np.array([drawn(place, line) for place in places], dtype=bool).reshape(-1, PIXELS, PIXELS)
        for line in (0, width)
    )
    eroded = cv2.erode(floor, np.ones((width, width))) if width else floor
    return FloorMap(floor.astype(bool), boxes, grown, np.asarray(eroded).astype(bool))


def largest_share(areas: Int[np.ndarray, "pixels pixels"]) -> float:
    """Share of the largest area in the pixels of all areas; 0 if there are no areas."""
    sizes = np.bincount(areas.ravel())[1:]
    return float(sizes.max() / sizes.sum()) if len(sizes) else 0.0


@metric(
    "sceneeval_navigability", "NAV: navigable in one piece (SceneEval)",
    "share of free floor; known floors only", "higher", USED,
)  # fmt: skip
def navigability(scene: Scene) -> Counts:
    """The largest connected area of free floor, as a share of all free floor: SceneEval's NAV.

    The robot is 0.2 m wide, and objects whose centre is above 2 m are no obstacles. 0 if no floor
    is free; unknown without a floor outline.

    Source:
        3dlg-hcvc/SceneEval, metrics/navigability.py, with the default settings of its configs.
        Box corners may lie one pixel (about 3 cm) from those in SceneEval's map.
    """
    found = floor_map(scene, SCENEEVAL_ROBOT_M)
    if found is None:
        return {}
    free = found.free(scene.centers_m[:, 1] <= SCENEEVAL_HEIGHT_M)
    return {"sceneeval_navigability": (largest_share(free), 1.0)}


@metric(
    "physcene_out", "R_out: objects beyond the floor (PhyScene)", "share; known floors only",
    "lower", USED,
)  # fmt: skip
@metric(
    "physcene_reach", "R_reach: objects within reach (PhyScene)", "share; known floors only",
    "higher", USED, column=TableColumn("in reach", 2, "in reach: objects that one can walk to"),
)  # fmt: skip
@metric(
    "physcene_walkable", "Walkable in one piece (PhyScene)",
    "share of free floor; known floors only", "higher", USED,
)  # fmt: skip
def reach(scene: Scene) -> Counts:
    """PhyScene's R_out, R_reach and walkable area, for a robot of 0.3 m; unknown without a floor.

    R_out counts objects whose box covers a pixel outside the floor. R_reach is the expected share
    of objects next to an area of free floor that is chosen with probability proportional to its
    size. An object is next to an area if its box, grown by half the robot's width and one pixel,
    touches the area; all objects are obstacles, even ceiling lamps. The walkable area is the
    largest connected area of free floor as a share of all free floor, where objects whose centre is
    at 1.5 m or above are no obstacles. R_reach and the walkable area are 0 if no floor is free.

    Source:
        PhyScene/PhyScene, utils/overlap.py and scripts/eval/walkable_metric.py (Yang et al.,
        CVPR 2024). The published `cal_walkable_metric` returns inside its loop over areas, so it
        gives the share of the first area in row order; here, as the variable names intend, the
        share of the largest area is computed. Its variant for areas beside doors, which the
        published evaluation does not use, is left out.
    """
    from scipy.ndimage import binary_dilation

    found, count = floor_map(scene, PHYSCENE_ROBOT_M), len(scene.objects)
    if found is None:
        return {}
    outside = (found.boxes & ~found.floor).any(axis=(1, 2))
    areas = found.free(np.ones(count, dtype=bool))
    sizes = np.bincount(areas.ravel())[1:]
    reached = 0.0
    for box in found.grown:
        touched = np.unique(areas[binary_dilation(box, np.ones((3, 3)))])
        reached += sizes[touched[touched > 0] - 1].sum() / max(sizes.sum(), 1)
    walkable = largest_share(found.free(scene.centers_m[:, 1] < PHYSCENE_HEIGHT_M))
    return {
        "physcene_out": (float(outside.sum()), float(count)),
        "physcene_reach": (reached / max(count, 1), float(count > 0)),
        "physcene_walkable": (walkable, 1.0),
    }


_OPENINGS = "doors or windows (openings) in the scenes"


@metric(
    "sceneeval_clear_openings", "Doors and windows with nothing before them (SceneEval)",
    "share; known openings only", "higher", USED, needs=_OPENINGS,
)  # fmt: skip
@metric(
    "sceneeval_covered_openings", "Area of doors and windows that is covered (SceneEval)",
    "share; known openings only", "lower", USED, needs=_OPENINGS,
)  # fmt: skip
def clear_openings(scene: Scene) -> Counts:
    """Test the space in front of each door and window, inside the room.

    The space is as wide and high as the opening. Its depth is the door's width, or 0.5 m for a
    window. An object reaches into the space if one of the random points in its box does (5,000 per
    cubic metre, at least 64). The triangles of such objects that lie at least partly within the
    space's depth are projected onto the opening, on a grid of 100 pixels per metre. The opening is
    blocked if there are such triangles, and covered by the share of its pixels that they cover. An
    opening with the room on neither side does not count.

    Source:
        3dlg-hcvc/SceneEval, metrics/opening_clearance.py, with its default settings: only the side
        in the room. SceneEval's openings are 1 mm thick, which adds 0.5 mm to the depth; here they
        have no thickness.
    """
    import cv2

    floor = floor_polygon(scene)
    if floor is None or not scene.openings:
        return {}
    draws = np.random.default_rng(0)
    points = [
        in_own_box(item, draws.uniform(-0.5, 0.5, (point_count(item, FEWEST_POINTS), 3)))
        for item in scene.objects
    ]
    frames = [frame for each in scene.openings if (frame := _frame(each, floor)) is not None]
    clear, covered = 0, 0.0
    for frame in frames:
        width, height, depth = frame.size_m
        near = (
            frame.local(triangles_of(item))
            for item, inner in zip(scene.objects, points, strict=True)
            if frame.holds(inner)
        )
        before = np.concatenate([np.zeros((0, 3, 3)), *near])
        inward = before[:, :, 2]
        before = before[(inward.min(axis=1) <= depth) & (inward.max(axis=1) >= 0)]
        image = np.zeros(np.ceil([height * PIXELS_PER_M, width * PIXELS_PER_M]).astype(int), "u1")
        for triangle in before:
            pixels = np.stack([triangle[:, 0], height - triangle[:, 1]], axis=1) * PIXELS_PER_M
            cv2.fillConvexPoly(image, pixels.astype(np.int32), 1)
        clear, covered = clear + (not len(before)), covered + float(image.mean())
    return {
        "sceneeval_clear_openings": (float(clear), len(frames)),
        "sceneeval_covered_openings": (covered, len(frames)),
    }


class _Frame(NamedTuple):
    """Coordinate frame of an opening: along it, above its lower edge, and into the room."""

    origin_m: Float[np.ndarray, "3"]
    axes: Float[np.ndarray, "3 3"]
    size_m: Float[np.ndarray, "3"]

    def local(self, points: np.ndarray) -> np.ndarray:
        return np.asarray((points - self.origin_m) @ self.axes.T)

    def holds(self, points: Points) -> bool:
        local = self.local(points)
        inside = (local >= -TOLERANCE_M) & (local <= self.size_m + TOLERANCE_M)
        return bool(inside.all(axis=1).any())


def _frame(opening: Opening, floor: shapely.Geometry) -> _Frame | None:
    """The frame of an opening; None if the room is on neither side of it."""
    start, end = (np.array([x, opening.bottom_m, z]) for x, z in (opening.start_m, opening.end_m))
    width = float(np.linalg.norm(end - start))
    along, up = (end - start) / width, np.array([0.0, 1.0, 0.0])
    for inward in (np.cross(along, up), np.cross(up, along)):
        tested = (start + end) / 2 + TEST_M * inward
        if shapely.contains_xy(floor, tested[0], tested[2]):
            depth = width if opening.kind == "door" else BEFORE_WINDOW_M
            size_m = np.array([width, opening.top_m - opening.bottom_m, depth])
            return _Frame(start, np.array([along, up, inward]), size_m)
    return None
