"""Random rooms for shards, and what is known of them in 3D."""

from dataclasses import replace

import numpy as np

from sceneprior.core.classes import STUFF
from sceneprior.core.observations import RoomGroundTruth, RoomViews, stuff_size


def make_room(room_id="house_A", views=3, objects=2, size=(12, 16), seed=0):
    rng = np.random.default_rng(seed)
    visible = rng.random((views, objects)) < 0.7
    return RoomViews(
        room_id=room_id,
        object_class=rng.integers(1, 22, objects).astype(np.int16),
        world_to_camera=rng.normal(size=(views, 4, 4)).astype(np.float32),
        intrinsics=rng.normal(size=(views, 3, 3)).astype(np.float32),
        boxes=rng.random((views, objects, 4)).astype(np.float32) * visible[..., None],
        visible=visible,
        mask_pixels=(rng.integers(25, 99, (views, objects)) * visible).astype(np.int32),
        sides_clear=rng.random((views, objects, 4)) < 0.5,
        instance_ids=rng.integers(0, objects + 1, (views, *size)).astype(np.uint8),
        image_size=size,
    )


def with_stuff(room, seed=0):
    shape = (len(room.visible), *stuff_size(room.image_size))
    stuff = np.random.default_rng(seed).integers(0, len(STUFF), shape).astype(np.uint8)
    return replace(room, stuff=stuff)


def make_truth(objects=3, seed=0):
    rng = np.random.default_rng(seed)
    return RoomGroundTruth(
        object_class=rng.integers(1, 22, objects).astype(np.int16),
        centers_m=rng.normal(size=(objects, 3)).astype(np.float32),
        sizes_m=rng.random((objects, 3)).astype(np.float32),
        yaw_rad=rng.normal(size=objects).astype(np.float32),
        model_ids=tuple(f"model-{k}" for k in range(objects)),
        model_to_room=rng.normal(size=(objects, 4, 4)).astype(np.float32),
        floor_m=rng.normal(size=(6, 2)).astype(np.float32),
        height_m=2.7,
        unoccluded=rng.random((3, 2)) < 0.5,  # of the views and objects that make_room has
    )
