"""Agreement between the projected 3D objects of a room's ground truth and their 2D masks."""

import warnings
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
from sceneprior.core.errors import ShardError
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

    @property
    def middle_m(self) -> np.ndarray:
        """Centre of the axis-aligned bounding box."""
        return (self.points_m.min(axis=0) + self.points_m.max(axis=0)) / 2


class Body(NamedTuple):
    """An object in the room frame: its mesh, or its 3D box."""

    kind: str
    """A key of `KINDS`."""
    hull: Hull
    unoccluded: np.ndarray | None = None
    """(T,) bool, as in `RoomGroundTruth`; None if only tracked objects can occlude it."""


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
                problems += _box_problem(k, placed, truth)
            except ShardError as error:
                body = None
                problems.append(str(error).removesuffix("."))
        if body is not None and truth.unoccluded is not None and k < truth.unoccluded.shape[1]:
            body = body._replace(unoccluded=truth.unoccluded[:, k])
        bodies.append(body)
    return bodies[: len(views.object_class)], problems


def _box_problem(k: int, points: np.ndarray, truth: RoomGroundTruth) -> list[str]:
    half = truth.sizes_m[k].astype(np.float64) / 2
    stored = np.stack([truth.centers_m[k] - half, truth.centers_m[k] + half])
    off = np.abs(stored - np.stack([points.min(axis=0), points.max(axis=0)])).max()
    if off <= _BOX_SLACK_M + 1e-5 * np.abs(stored).max():
        return []
    return [f"the 3D box of object {k} differs by {off:.3f} m from the box around its placed mesh"]


def boxes_around(hull: Hull, world_to_camera: np.ndarray, intrinsics: np.ndarray) -> np.ndarray:
    """2D bounding box of a projected body in each view, not clipped at the image borders.

    (T, 4) x1, y1, x2, y2 in pixels, of the part beyond the near plane; NaN if there is none.
    """
    camera = to_camera(hull.points_m, world_to_camera.astype(np.float64))
    lenses = intrinsics.astype(np.float64)
    ahead = camera[..., 2] >= NEAR_M
    pixels = to_pixels(np.where(ahead[..., None], camera, np.nan), lenses)
    with warnings.catch_warnings():  # nanmin warns if the whole body is behind the camera
        warnings.simplefilter("ignore", RuntimeWarning)
        boxes = np.concatenate([np.nanmin(pixels, axis=1), np.nanmax(pixels, axis=1)], axis=1)
    for view in np.flatnonzero(ahead.any(axis=1) & ~ahead.all(axis=1)):
        crossing = hull.edges[ahead[view, hull.edges].sum(axis=1) == 1]
        a, b = camera[view, crossing[:, 0]], camera[view, crossing[:, 1]]
        share = (NEAR_M - a[:, 2:]) / (b[:, 2:] - a[:, 2:])
        cut = to_pixels(a + (b - a) * share, lenses[view])
        boxes[view, :2] = np.minimum(boxes[view, :2], cut.min(axis=0))
        boxes[view, 2:] = np.maximum(boxes[view, 2:], cut.max(axis=0))
    return boxes


def box_iou_2d(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Intersection over union of 2D boxes, row by row; NaN if a box is NaN or both are empty.

    Example: two squares that overlap by one half.

        >>> box_iou_2d(np.array([[0.0, 0, 2, 2]]), np.array([[1.0, 0, 3, 2]])).round(3).tolist()
        [0.333]
    """
    low, high = np.maximum(a[..., :2], b[..., :2]), np.minimum(a[..., 2:], b[..., 2:])
    shared = np.maximum(high - low, 0).prod(axis=-1)
    areas = [(box[..., 2:] - box[..., :2]).prod(axis=-1) for box in (a, b)]
    union = np.asarray(areas[0] + areas[1] - shared)
    return np.divide(shared, union, out=np.full(union.shape, np.nan), where=union > 0)


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
    total: Agreement = {}
    for agreement in agreements:
        for kind, tally in agreement.items():
            before = total.get(kind, Tally(kind))
            sums = (a + b for a, b in zip(before[1:], tally[1:], strict=True))
            total[kind] = Tally._make((kind, *sums))
    return {kind: total[kind] for kind in KINDS if kind in total}


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
            of = np.array([name == kind for name in self.kinds], dtype=bool)
            if (judged := self.judged & of).any():
                held, whole = self.held & judged, self.whole & judged
                iou = float(self.iou[whole].sum())
                counts = (int(flags.sum()) for flags in (judged, held, whole))
                tallies[kind] = Tally._make((kind, *counts, iou))
        return tallies


def projections(room: Room) -> np.ndarray:
    """Project each body to a 2D box in each view: (T, n, 4) pixels, NaN behind the camera."""
    views = room.views
    boxes = np.full((len(views.visible), len(room.bodies), 4), np.nan)
    for k, body in enumerate(room.bodies):
        if body is not None:
            boxes[:, k] = boxes_around(body.hull, views.world_to_camera, views.intrinsics)
    return boxes


def compare(room: Room) -> Comparison:
    """Compare the projections of objects with their masks in all views."""
    return compare_boxes(room, projections(room))


def compare_boxes(room: Room, boxes_px: np.ndarray) -> Comparison:
    """Compare given projections, (..., T, n, 4), with the masks."""
    views = room.views
    masks = views.boxes * np.tile(room.size_px, 2)
    margin = MARGIN * max(views.image_size)
    # Comparisons with NaN (behind the camera) are false: undefined projections disagree.
    begins = (boxes_px[..., :2] <= masks[..., :2] + margin).all(axis=-1)
    held = np.logical_and(begins, (boxes_px[..., 2:] >= masks[..., 2:] - margin).all(axis=-1))
    whole = np.asarray(own_sides(views, views.image_size).all(axis=-1))
    for k, body in enumerate(room.bodies):
        if body is not None and body.unoccluded is not None:
            whole[:, k] &= body.unoccluded
    there = np.array([body is not None for body in room.bodies], dtype=bool)
    return Comparison(
        tuple(body.kind if body else "" for body in room.bodies),
        views.visible & there,
        held,
        whole,
        np.nan_to_num(box_iou_2d(boxes_px, masks)),
    )
