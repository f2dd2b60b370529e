"""Agreement between the projected 3D objects of a room's ground truth and their 2D masks."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from data_prep.readers.upright import own_sides
from sceneprior.core.boxes import BOX_EDGES, box_corners
from sceneprior.core.cameras import to_camera, to_pixels
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import load_model, model_path
from sceneprior.core.observations import RoomGroundTruth, RoomViews

KINDS = {"mesh": "meshes", "box": "3D boxes"}
"""Names of the types of 3D representations, for messages."""
NEAR_M = 0.05
"""Depth of the near plane, at which lines are clipped."""
MARGIN = 0.02
"""Tolerance by which a mask may exceed its object's projection, relative to the image's longer
side. A pose error of 5 cm has this effect at a distance of 2.5 m, in views of 90 degrees."""
HELD_AT_LEAST = {"mesh": 0.95, "box": 0.8}
"""Minimum share of masks that lie within their projections. Occluders and the image border only
shrink masks, so with correct poses all masks should. Shuffled cameras reach 0.07 to 0.15."""
IOU_AT_LEAST = {"mesh": 0.85, "box": 0.5}
"""Minimum mean IoU of the 2D boxes of fully visible objects. A mesh and its mask agree to the
pixel, except for parts thinner than a pixel. The corners of a 3D box project beyond its object's
silhouette, and annotated boxes are fitted to incomplete scans."""
_BOX_SLACK_M = 0.005
"""Tolerance between the stored box and the placed mesh, whose vertices are float32."""


class Hull(NamedTuple):
    """Vertices of a convex body, and its edges as pairs of rows."""

    points_m: np.ndarray
    """(P, 3)"""
    edges: np.ndarray
    """(E, 2)"""


class Body(NamedTuple):
    """An object in the room frame: its mesh, or its 3D box."""

    kind: str
    """A key of `KINDS`."""
    hull: Hull
    unoccluded: np.ndarray | bool = True
    """(T,) bool, as in `RoomGroundTruth`; True if only tracked objects can occlude it."""


class Room(NamedTuple):
    """A room's masks and cameras, and its 3D objects if they are known."""

    views: RoomViews
    bodies: Sequence[Body | None] = ()
    """One per tracked object, None where the 3D representation cannot be read; empty without 3D
    ground truth."""

    @property
    def size_px(self) -> np.ndarray:
        """Width and height of the images."""
        return np.array(self.views.image_size[::-1], dtype=np.float64)

    def seen_by(self, poses: np.ndarray | None = None, lenses: np.ndarray | None = None) -> "Room":
        """The same room with other world-to-camera matrices or intrinsics."""
        views = self.views
        poses = views.world_to_camera if poses is None else poses
        lenses = views.intrinsics if lenses is None else lenses
        return self._replace(views=replace(views, world_to_camera=poses, intrinsics=lenses))


def hull_of(points_m: np.ndarray) -> Hull:
    """Convex hull of points, (P, 3): it has the same projected 2D box with fewer points."""
    low, high = points_m.min(axis=0), points_m.max(axis=0)
    try:
        # Points are joggled (QJ), because flat point sets have no hull.
        found = ConvexHull(points_m, qhull_options="QJ")
    except QhullError:
        return Hull(box_corners((low + high) / 2, high - low), np.array(BOX_EDGES))
    number = np.zeros(len(points_m), dtype=np.int64)
    number[found.vertices] = np.arange(len(found.vertices))
    edges = number[np.concatenate([found.simplices[:, pair] for pair in ([0, 1], [1, 2], [2, 0])])]
    return Hull(points_m[found.vertices], np.unique(np.sort(edges, axis=1), axis=0))


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
                placed = to_camera(hull.points_m, truth.model_to_room[k].astype(np.float64))
                body = Body("mesh", Hull(placed, hull.edges))
                half = truth.sizes_m[k].astype(np.float64) / 2
                stored = np.stack([truth.centers_m[k] - half, truth.centers_m[k] + half])
                off = np.abs(stored - [placed.min(axis=0), placed.max(axis=0)]).max()
                if off > _BOX_SLACK_M + 1e-5 * np.abs(stored).max():
                    problems.append(
                        f"the 3D box of object {k} differs by {off:.3f} m from the box around its "
                        "placed mesh"
                    )
            except InputError as error:
                body = None
                problems.append(str(error).removesuffix("."))
        if body is not None and truth.unoccluded is not None and k < truth.unoccluded.shape[1]:
            body = body._replace(unoccluded=truth.unoccluded[:, k])
        bodies.append(body)
    return bodies[: len(views.object_class)], problems


def project_edges(hull: Hull, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """Edges as lines in the images, (..., E, 4) u1, v1, u2, v2 in pixels, clipped at the near
    plane; NaN for an edge that does not reach beyond it.

    Example: a line that begins 1 m behind the camera is visible from the near plane on.

        >>> line = Hull(np.array([[0.0, 0, -1], [0.2, 0, 2]]), np.array([[0, 1]]))
        >>> project_edges(line, np.eye(4), np.diag([10.0, 10, 1])).round(6).tolist()
        [[14.0, 0.0, 1.0, 0.0]]
    """
    points = to_camera(hull.points_m.astype(np.float64), world_to_camera.astype(np.float64))
    ends = points[..., hull.edges, :]
    others = ends[..., ::-1, :]
    # An end before the near plane moves along its edge to the plane.
    near, far = ends[..., 2:], others[..., 2:]
    clipped = (near < NEAR_M) & (far >= NEAR_M)
    share = np.where(clipped, (NEAR_M - near) / np.where(clipped, far - near, 1.0), 0.0)
    ends = np.where((near < NEAR_M) & ~clipped, np.nan, ends + share * (others - ends))
    pixels = to_pixels(ends.reshape(*ends.shape[:-3], -1, 3), intrinsics.astype(np.float64))
    return pixels.reshape(*ends.shape[:-2], 4)


def boxes_around(hull: Hull, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """2D bounding box of a projected body in each view, not clipped at the image borders.

    (T, 4) x1, y1, x2, y2 in pixels, of the part beyond the near plane; NaN if there is none.
    """
    lines = project_edges(hull, world_to_camera, intrinsics)
    pixels = lines.reshape(len(lines), -1, 2)
    boxes = [np.fmin.reduce(pixels, axis=1), np.fmax.reduce(pixels, axis=1)]  # these skip NaN
    return np.concatenate(boxes, axis=1)


class Limits(NamedTuple):
    """Minima of agreement: a share of the general ones, where at least so many masks count."""

    share: float = 1.0
    masks: int = 1


class Tally(NamedTuple):
    """Sums over objects and views, for one type of 3D representation."""

    kind: str
    """A key of `KINDS`."""
    masks: int = 0
    held: int = 0
    """Number of masks within their projections."""
    whole: int = 0
    """Number of masks of fully visible objects."""
    iou: float = 0.0
    """IoU between the 2D boxes of mask and projection, summed over the fully visible objects."""

    @property
    def share(self) -> float:
        """Share of the masks that lie within their projections."""
        return self.held / max(self.masks, 1)

    @property
    def mean_iou(self) -> float:
        """Mean IoU over the fully visible objects; 0 if there are none."""
        return self.iou / max(self.whole, 1)

    def passes(self, limits: Limits) -> bool:
        """Test whether both measures reach the limits."""
        share, iou = limits.share * HELD_AT_LEAST[self.kind], limits.share * IOU_AT_LEAST[self.kind]
        held = self.masks < limits.masks or self.share >= share
        return held and (self.whole < limits.masks or self.mean_iou >= iou)


Agreement = dict[str, Tally]
"""Tallies by key of `KINDS`, for those that occur."""


def added(agreements: Iterable[Agreement]) -> Agreement:
    """Sum of agreements."""
    every = [tally for agreement in agreements for tally in agreement.values()]
    of_kind = {kind: [tally[1:] for tally in every if tally.kind == kind] for kind in KINDS}
    return {k: Tally(k, *map(sum, zip(*rows, strict=True))) for k, rows in of_kind.items() if rows}


def failing(agreement: Agreement, limits: Limits) -> list[Tally]:
    """Tallies that do not pass."""
    return [tally for tally in agreement.values() if not tally.passes(limits)]


def score(agreement: Agreement) -> float:
    """Sum of both measures over the types of 3D representations."""
    return sum(tally.share + tally.mean_iou for tally in agreement.values())


class Comparison(NamedTuple):
    """Comparison of projection and mask for each object in each view."""

    kinds: tuple[str, ...]
    """(n,) keys of `KINDS`; "" for an object without a 3D representation."""
    judged: np.ndarray
    """(T, n) bool: the view has a mask of the object, which has a 3D representation."""
    held: np.ndarray
    """(T, n) bool: the mask lies within the projection; False where that is undefined."""
    whole: np.ndarray
    """(T, n) bool: the object is fully visible, that is, cut off neither by the image border nor by
    another object nor (if the ground truth is known) by anything else in the room."""
    iou: np.ndarray
    """(T, n) IoU of the 2D boxes of mask and projection; 0 where that is undefined."""

    @property
    def agreement(self) -> Agreement:
        """The comparison summed over objects and views, for each kind of 3D representation."""
        tallies = {}
        for kind in KINDS:
            judged = self.judged & (np.array(self.kinds, dtype=object) == kind)
            if judged.any():
                held, whole = self.held & judged, self.whole & judged
                counts = (int(flags.sum()) for flags in (judged, held, whole))
                tallies[kind] = Tally._make((kind, *counts, float(self.iou[whole].sum())))
        return tallies


def compare(room: Room) -> Comparison:
    """Compare the projections of objects with their masks in all views."""
    views = room.views
    masks = views.boxes * np.tile(room.size_px, 2)
    boxes = np.full(masks.shape, np.nan)
    judged = views.visible.copy()
    whole = np.asarray(own_sides(views, views.image_size).all(axis=-1))
    for k, body in enumerate(room.bodies):
        if body is None:
            judged[:, k] = False
        else:
            boxes[:, k] = boxes_around(body.hull, views.world_to_camera, views.intrinsics)
            whole[:, k] &= body.unoccluded
    margin = MARGIN * max(views.image_size)
    # Comparisons with NaN (behind the camera) are false: undefined projections disagree.
    begins = (boxes[..., :2] <= masks[..., :2] + margin).all(axis=-1)
    held = np.logical_and(begins, (boxes[..., 2:] >= masks[..., 2:] - margin).all(axis=-1))
    low = np.maximum(boxes[..., :2], masks[..., :2])
    high = np.minimum(boxes[..., 2:], masks[..., 2:])
    shared = np.maximum(high - low, 0).prod(axis=-1)
    union = sum((box[..., 2:] - box[..., :2]).prod(axis=-1) for box in (boxes, masks)) - shared
    iou = np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)
    kinds = tuple(body.kind if body else "" for body in room.bodies)
    return Comparison(kinds, judged, held, whole, iou)
