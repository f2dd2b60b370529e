"""One room in 3D in, what cameras saw of it out."""

import hashlib
from collections.abc import Sequence

import numpy as np

from data_prep.front.furnished import Furniture, Room
from data_prep.front.viewpoints import Viewpoints, intrinsics, sees_enough
from data_prep.recipe import Recipe, ViewRules
from sceneprior.classes import label_set
from sceneprior.instances.observations import Observations, observe, pixel_counts
from sceneprior.offscreen import Renderer
from sceneprior.scene import Mesh
from sceneprior.shards import RoomGroundTruth, RoomViews


def prepare_room(
    room: Room, count: int, recipe: Recipe, seed: int, renderer: Renderer
) -> tuple[RoomViews, RoomGroundTruth] | None:
    """Draw one room and measure what was seen; None if no view shows an object.

    The same seed and room give the same arrays, whatever was prepared before.
    """
    word = hashlib.sha256(f"{seed}:{room.room_id}".encode()).digest()
    rng = np.random.default_rng(int.from_bytes(word[:16], "little"))
    names = label_set(recipe.label_set)
    meshes = [piece.mesh for piece in room.furniture]
    boxes_m = np.array([(m.vertices_m.min(axis=0), m.vertices_m.max(axis=0)) for m in meshes])
    is_object = np.array([piece.label != "void" for piece in room.furniture])
    spots = Viewpoints(room, boxes_m, boxes_m[is_object].mean(axis=1), recipe.views, rng)
    world_to_camera, images = _draw_views(spots, meshes, is_object, count, recipe.views, renderer)
    seen = observe(images, is_object)
    if not len(seen.tracked):
        return None
    return (
        RoomViews(
            room_id=room.room_id,
            object_class=np.array(
                [names.index(room.furniture[k].label) for k in seen.tracked], dtype=np.int16
            ),
            world_to_camera=world_to_camera.astype(np.float32),
            intrinsics=np.repeat(
                intrinsics(recipe.views).astype(np.float32)[None], len(images), axis=0
            ),
            boxes=seen.boxes,
            visible=seen.visible,
            mask_pixels=seen.mask_pixels,
            sides_clear=seen.sides_clear,
            instance_ids=seen.instance_ids,
            image_size=recipe.views.image_size,
        ),
        _ground_truth(room, boxes_m, seen, is_object, names),
    )


def _draw_views(
    spots: Viewpoints,
    meshes: Sequence[Mesh],
    is_object: np.ndarray,
    count: int,
    rules: ViewRules,
    renderer: Renderer,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw `count` views; those that see too little are drawn again, and the best try stays."""
    cameras = [spots.draw() for _ in range(count)]
    images = renderer.instance_ids_of_views(meshes, cameras, rules.image_size)
    scores = np.zeros(count)
    open_views = []
    for view in range(count):
        good, scores[view] = sees_enough(pixel_counts(images[view], len(meshes))[is_object], rules)
        if not good:
            open_views.append(view)
    for _ in range(rules.tries - 1):
        if not open_views:
            break
        retries = [spots.draw() for _ in open_views]
        drawn = renderer.instance_ids_of_views(meshes, retries, rules.image_size)
        still_open = []
        for view, camera, image in zip(open_views, retries, drawn, strict=True):
            good, score = sees_enough(pixel_counts(image, len(meshes))[is_object], rules)
            if good or score > scores[view]:
                cameras[view], images[view], scores[view] = camera, image, score
            if not good:
                still_open.append(view)
        open_views = still_open
    return np.stack([camera.world_to_camera for camera in cameras]), images


def _ground_truth(
    room: Room,
    boxes_m: np.ndarray,
    seen: Observations,
    is_object: np.ndarray,
    names: tuple[str, ...],
) -> RoomGroundTruth:
    unseen = np.setdiff1d(np.flatnonzero(is_object), seen.tracked)
    order = [*seen.tracked.tolist(), *unseen.tolist()]
    pieces: list[Furniture] = [room.furniture[k] for k in order]
    lower, upper = boxes_m[order, 0], boxes_m[order, 1]
    return RoomGroundTruth(
        object_class=np.array([names.index(piece.label) for piece in pieces], dtype=np.int16),
        centers_m=((lower + upper) / 2).astype(np.float32),
        sizes_m=(upper - lower).astype(np.float32),
        yaw_rad=np.array([piece.yaw_rad for piece in pieces], dtype=np.float32),
        model_ids=tuple(piece.model_id for piece in pieces),
        model_to_room=np.array([piece.model_to_room for piece in pieces], dtype=np.float32),
        floor_m=room.floor_outline_m.astype(np.float32),
        height_m=room.height_m,
    )
