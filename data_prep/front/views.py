"""Draws the views of a room: samples its cameras, renders them and labels the visible objects."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import shapely

from data_prep.front.furnished import Room
from data_prep.front.recipe import Recipe, ViewRules
from sceneprior.core.cameras import Pinhole, camera_at, to_camera
from sceneprior.core.classes import STUFF, VOID, label_set
from sceneprior.core.observations import (
    RoomGroundTruth,
    RoomViews,
    observe,
    pixel_counts,
    stuff_size,
    stuff_step,
    thinned,
    thinned_intrinsics,
)
from sceneprior.core.scene import Mesh
from sceneprior.render.offscreen import Renderer

_PLACES = 200  # random positions tried before a rule is relaxed
_DARTS = 10_000  # random points tried before a point known to lie inside is taken


def view_counts(floor_areas_m2: Sequence[float], rules: ViewRules) -> list[int]:
    """Numbers of views of the rooms of one house, in proportion to their floor areas.

    If they would sum to more than `per_house_at_most`, this number is shared by area. Every room
    gets at least `at_least` views, or an equal share if the house has too many rooms for that, but
    never fewer than one.

    Example:

        >>> view_counts([10.0, 40.0, 50.0], ViewRules())
        [10, 40, 50]
    """
    wanted = [rules.per_m2 * area for area in floor_areas_m2]
    share = min(1.0, rules.per_house_at_most / max(sum(wanted), 1e-9))
    limit = max(rules.per_house_at_most, len(wanted))
    least = min(rules.at_least, limit // max(len(wanted), 1))
    counts = [max(least, round(views * share)) for views in wanted]
    while sum(counts) > limit:  # rounding up, and small rooms that got the least
        surplus = [
            (count - views * share if count > least else -math.inf)
            for count, views in zip(counts, wanted, strict=True)
        ]
        counts[surplus.index(max(surplus))] -= 1
    return counts


def intrinsics(rules: ViewRules) -> np.ndarray:
    """Intrinsics, (3, 3) float64 in pixels: square pixels, principal point at the image centre."""
    height, width = rules.image_size
    focal_px = width / 2 / math.tan(math.radians(rules.fov_deg) / 2)
    return np.array([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])


def camera_pose(eye_m: np.ndarray, yaw_rad: float, pitch_rad: float) -> np.ndarray:
    """World-to-camera matrix (4, 4) of a camera that looks along +z, rotated by yaw and pitch.

    Positive pitch looks down.

    Example: looking along +z, +x is on the left; points above the camera have a negative camera y.

        >>> (camera_pose(np.zeros(3), 0.0, 0.0) @ [1, 2, 3, 1]).tolist()
        [-1.0, -2.0, 3.0, 1.0]
    """
    sin_yaw, cos_yaw = math.sin(yaw_rad), math.cos(yaw_rad)
    sin_pitch, cos_pitch = math.sin(pitch_rad), math.cos(pitch_rad)
    right_down_ahead = (
        (-cos_yaw, 0.0, sin_yaw),  # right
        (-sin_pitch * sin_yaw, -cos_pitch, -sin_pitch * cos_yaw),  # down
        (sin_yaw * cos_pitch, -sin_pitch, cos_yaw * cos_pitch),  # forward
    )
    return camera_at(np.array(right_down_ahead), eye_m)


class Viewpoints:
    """Samples cameras above a room's floor, aimed at one object after the other.

    `boxes_m`, (pieces, 2, 3), are the lower and upper corners of all furniture in the room frame,
    and `targets_m`, (k, 3), the centres of the objects to aim at.
    """

    def __init__(
        self,
        room: Room,
        boxes_m: np.ndarray,
        targets_m: np.ndarray,
        rules: ViewRules,
        rng: np.random.Generator,
    ):
        self._boxes = np.asarray(boxes_m, dtype=np.float64).reshape(-1, 2, 3)
        self._targets = np.asarray(targets_m, dtype=np.float64).reshape(-1, 3)
        self._rules = rules
        self._rng = rng
        self._intrinsics = intrinsics(rules)
        self._enough = min(rules.min_objects, len(self._targets))
        self._queue: list[int] = []
        self._area = room.floor
        # Narrow rooms have no point far from every wall, so the margin shrinks.
        for margin in (rules.wall_margin_m, rules.wall_margin_m / 2, 0.05):
            inner = room.floor.buffer(-margin)
            if inner.area > 0.05:
                self._area = inner
                break
        shapely.prepare(self._area)

    def draw(self) -> Pinhole:
        """Sample one more camera."""
        rules, rng = self._rules, self._rng
        target = self._next_target()
        for attempt in range(3 * _PLACES):
            eye = self._place()
            yaw = math.atan2(target[0] - eye[0], target[2] - eye[2])
            yaw += rng.normal(0.0, math.radians(15))
            away = math.hypot(target[0] - eye[0], target[2] - eye[2])
            pitch = self._pitch(math.atan2(target[1] - eye[1], away))
            camera = Pinhole(camera_pose(eye, yaw, pitch), self._intrinsics)
            # Some rooms have no view of enough objects, and some are too full for the margins:
            # each third of the attempts drops one more of these requirements.
            poor = away < rules.target_distance_m or self._in_view(camera) < self._enough
            if attempt < _PLACES and poor:
                continue
            if not self._blocked(camera, eye, strict=attempt < 2 * _PLACES):
                break
        return camera

    def _next_target(self) -> np.ndarray:
        if not len(self._targets):
            return np.zeros(3)
        if not self._queue:
            self._queue = self._rng.permutation(len(self._targets)).tolist()
        return self._targets[self._queue.pop()]

    def _place(self) -> np.ndarray:
        x1, z1, x2, z2 = self._area.bounds
        for _ in range(_DARTS):
            x, z = self._rng.uniform((x1, z1), (x2, z2))
            if shapely.contains_xy(self._area, x, z):
                return np.array([x, self._rng.uniform(*self._rules.eye_height_m), z])
        # The floor consists of slivers far apart: put all further cameras at one interior point.
        self._area = self._area.representative_point().buffer(1e-3)
        return self._place()

    def _pitch(self, elevation_rad: float) -> float:
        """Sample a pitch, raised if needed to keep a high target (a ceiling lamp) in view."""
        pitch = math.radians(self._rng.uniform(*self._rules.pitch_deg))
        half_view = math.atan2(self._rules.image_size[0] / 2, self._intrinsics[1, 1])
        return max(min(pitch, 0.75 * half_view - elevation_rad), math.radians(-10))

    def _in_view(self, camera: Pinhole) -> int:
        """Count the object centres inside the image: a cheap estimate of the visible objects."""
        points = to_camera(self._targets, camera.world_to_camera)
        height, width = self._rules.image_size
        limits = np.array([width / 2, height / 2]) / self._intrinsics[0, 0]
        return int((np.abs(points[:, :2]) < limits * points[:, 2:]).all(axis=1).sum())

    def _blocked(self, camera: Pinhole, eye: np.ndarray, strict: bool) -> bool:
        """Test whether the camera is inside a piece's box, or a box lies just ahead of it."""
        margin = self._rules.furniture_margin_m if strict else 0.02
        ahead = self._rules.clear_ahead_m if strict else 0.0
        points = eye + np.linspace(0.0, ahead, 4)[:, None] * camera.world_to_camera[2, :3]
        inside = (points > self._boxes[:, None, 0] - margin) & (
            points < self._boxes[:, None, 1] + margin
        )
        return bool(inside.all(axis=2).any())


def sees_enough(pixels: np.ndarray, rules: ViewRules) -> tuple[bool, float]:
    """Test whether a view with these visible pixels of each object is accepted, and score it.

    Scores rank the rejected views.
    """
    height, width = rules.image_size
    seen = int((pixels >= rules.min_object_pixels).sum())
    share = float(pixels.max(initial=0)) / (height * width)
    return (
        seen >= min(rules.min_objects, len(pixels)) and share <= rules.max_object_share,
        seen - 2.0 * max(share - rules.max_object_share, 0.0) * len(pixels),
    )


def prepare_room(
    room: Room, count: int, recipe: Recipe, seed: int, renderer: Renderer
) -> tuple[RoomViews, RoomGroundTruth] | None:
    """Render one room and measure the visible objects; None if no view shows an object."""
    word = hashlib.sha256(f"{seed}:{room.room_id}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(word[:16], "little"))
    names = label_set(recipe.label_set)
    classes = np.array([names.index(piece.label) for piece in room.furniture], dtype=np.int16)
    meshes = [piece.mesh for piece in room.furniture]
    boxes_m = np.array([(m.vertices_m.min(axis=0), m.vertices_m.max(axis=0)) for m in meshes])
    is_object = classes != VOID
    spots = Viewpoints(room, boxes_m, boxes_m[is_object].mean(axis=1), recipe.views, rng)
    world_to_camera, images = _draw_views(spots, meshes, is_object, count, recipe.views, renderer)
    seen = observe(images, classes)
    if not len(seen.tracked):
        return None
    views = seen.room_views(room.room_id, world_to_camera, intrinsics(recipe.views))
    views = replace(views, stuff=_draw_stuff(room, views, renderer))
    order = np.concatenate([seen.tracked, seen.unseen])
    pieces = [room.furniture[k] for k in order]
    lower, upper = boxes_m[order, 0], boxes_m[order, 1]
    return views, RoomGroundTruth(
        object_class=classes[order],
        centers_m=((lower + upper) / 2).astype(np.float32),
        sizes_m=(upper - lower).astype(np.float32),
        yaw_rad=np.array([piece.yaw_rad for piece in pieces], dtype=np.float32),
        model_ids=tuple(piece.model_id for piece in pieces),
        model_to_room=np.array([piece.model_to_room for piece in pieces], dtype=np.float32),
        floor_m=room.floor_outline_m.astype(np.float32),
        height_m=room.height_m,
    )


def _draw_views(
    spots: Viewpoints,
    meshes: Sequence[Mesh],
    is_object: np.ndarray,
    count: int,
    rules: ViewRules,
    renderer: Renderer,
) -> tuple[np.ndarray, np.ndarray]:
    """Render `count` views; a rejected view (`sees_enough`) is redrawn, and the best try stays."""
    best: dict[int, tuple[float, np.ndarray, np.ndarray]] = {}
    open_views = list(range(count))
    for _ in range(rules.tries):
        if not open_views:
            break
        cameras = [spots.draw() for _ in open_views]
        images = renderer.instance_ids_of_views(meshes, cameras, rules.image_size)
        still_open = []
        for view, camera, image in zip(open_views, cameras, images, strict=True):
            good, score = sees_enough(pixel_counts(image, len(meshes))[is_object], rules)
            if good or view not in best or score > best[view][0]:
                best[view] = score, camera.world_to_camera, image
            if not good:
                still_open.append(view)
        open_views = still_open
    _, world_to_camera, chosen = zip(*(best[view] for view in range(count)), strict=True)
    return np.stack(world_to_camera), np.stack(chosen)


def _draw_stuff(room: Room, views: RoomViews, renderer: Renderer) -> np.ndarray:
    """Draw floor, walls, doors, windows and ceiling behind all furniture; see `RoomViews.stuff`."""
    corners = [room.shell.get(name, np.zeros((0, 3, 3))).reshape(-1, 3) for name in STUFF[1:]]
    # Triangles share no corners.
    meshes = [Mesh(each, np.arange(len(each), dtype=np.int32).reshape(-1, 3)) for each in corners]
    step = stuff_step(views.image_size)
    cameras = [
        Pinhole(turn.astype(np.float64), thinned_intrinsics(K, step))
        for turn, K in zip(views.world_to_camera, views.intrinsics, strict=True)
    ]
    stuff = renderer.instance_ids_of_views(meshes, cameras, stuff_size(views.image_size))
    assert views.instance_ids is not None
    free = views.instance_ids[(..., *thinned(step))] == 0
    return np.where(free, stuff, 0).astype(np.uint8)
