"""Renders the views of one 3D room and labels the objects visible in them."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from data_prep.front.furnished import Room
from data_prep.front.recipe import Recipe, ViewRules
from data_prep.front.viewpoints import Viewpoints, intrinsics, sees_enough
from sceneprior.core.cameras import Pinhole
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
    meshes = [soup(room.shell.get(name, np.zeros((0, 3, 3)))) for name in STUFF[1:]]
    step = stuff_step(views.image_size)
    cameras = [
        Pinhole(turn.astype(np.float64), thinned_intrinsics(K, step))
        for turn, K in zip(views.world_to_camera, views.intrinsics, strict=True)
    ]
    stuff = renderer.instance_ids_of_views(meshes, cameras, stuff_size(views.image_size))
    assert views.instance_ids is not None
    free = views.instance_ids[(..., *thinned(step))] == 0
    return np.where(free, stuff, 0).astype(np.uint8)


def soup(triangles: np.ndarray) -> Mesh:
    """Mesh of triangles, (F, 3, 3), that share no corners."""
    corners = triangles.reshape(-1, 3)
    return Mesh(corners, np.arange(len(corners), dtype=np.int32).reshape(-1, 3))
