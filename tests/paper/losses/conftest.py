"""A random batch: rooms of several sizes, padding, hidden objects, objects never seen."""

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from toy_rooms import look_at

from sceneprior.core.boxes import box_corners
from sceneprior.core.cameras import Boxes2D, boxes_of_points
from sceneprior.core.views import DecodedScenes, SceneViews

COUNTS = (4, 2, 3)
SLOTS, CLASSES, VIEWS, SIZE = 5, 6, 6, (24, 32)


@dataclass
class Batch:
    scenes: DecodedScenes
    boxes: Boxes2D
    views: SceneViews


def make_batch(seed: int = 0) -> Batch:
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    rooms, objects = len(COUNTS), max(COUNTS)
    is_object = torch.arange(objects) < torch.tensor(COUNTS)[:, None]
    visible = (uniform(rooms, VIEWS, objects) < 0.6) & is_object[:, None]
    visible[2, :, 1] = False  # tracked, but seen in none of the drawn views
    corner = uniform(rooms, VIEWS, objects, 2) * 0.6
    boxes = torch.cat([corner, corner + 0.1 + uniform(rooms, VIEWS, objects, 2) * 0.3], dim=-1)
    eyes = [[2.5 * np.sin(a), 1.5, 2.5 * np.cos(a)] for a in range(VIEWS)]
    poses = torch.from_numpy(
        np.stack([look_at(np.array(eye), np.array([0, 1, 0])) for eye in eyes])
    )
    lens = torch.tensor([[20.0, 0, 16], [0, 20, 12], [0, 0, 1]], dtype=torch.float64)
    views = SceneViews(
        room_index=torch.arange(rooms),
        object_class=torch.randint(1, CLASSES, (rooms, objects), generator=generator) * is_object,
        is_object=is_object,
        world_to_camera=poses.expand(rooms, VIEWS, 4, 4),
        intrinsics=lens.expand(rooms, VIEWS, 3, 3),
        boxes=boxes * visible[..., None],
        visible=visible,
        sides_clear=(uniform(rooms, VIEWS, objects, 4) < 0.7) & visible[..., None],
        image_size=SIZE,
        instance_ids=torch.randint(0, objects + 1, (rooms, VIEWS, 6, 8), generator=generator),
        mask_step=4,
        room_ids=("a", "b", "c"),
    )
    centers = (uniform(rooms, SLOTS, 3) - 0.5) * torch.tensor([6.0, 1.5, 6.0]) + 1
    scenes = DecodedScenes(
        class_logits=torch.randn(rooms, SLOTS, CLASSES, generator=generator, dtype=torch.float64),
        centers_m=centers,
        sizes_m=uniform(rooms, SLOTS, 3) + 0.2,
        completeness_logits=torch.randn(rooms, SLOTS, generator=generator, dtype=torch.float64),
    )
    return Batch(scenes, boxes_2d(scenes, views), views)


def boxes_2d(scenes: DecodedScenes, views: SceneViews) -> Boxes2D:
    corners = box_corners(scenes.centers_m, scenes.sizes_m)
    return boxes_of_points(corners, views.world_to_camera, views.intrinsics, views.image_size)


@pytest.fixture(params=range(3))
def batch(request) -> Batch:
    return make_batch(request.param)
