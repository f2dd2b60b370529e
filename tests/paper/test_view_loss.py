"""2D boxes of the view loss: of which predictions, and of meshes or of proxies."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_runs import tiny_config
from torch.testing import assert_close
from toy_rooms import look_at

from sceneprior.core.cameras import boxes_of_points
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.matching import seen_boxes


@pytest.fixture
def seen() -> tuple[DecodedScenes, SceneViews]:
    """Two rooms of three objects, wholly in front of four cameras and inside of their images."""
    generator = torch.Generator().manual_seed(0)
    rooms, views, objects = 2, 4, 3
    eyes = [[4 * np.sin(a), 1.5, 4 * np.cos(a)] for a in range(views)]
    poses = torch.from_numpy(np.stack([look_at(np.array(eye), np.zeros(3)) for eye in eyes]))
    lens = torch.tensor([[40.0, 0, 40], [0, 40, 30], [0, 0, 1]])
    empty = torch.zeros(rooms, views, objects, dtype=torch.bool)
    scenes = DecodedScenes(
        class_logits=torch.zeros(rooms, objects, 5),
        centers_m=torch.rand(rooms, objects, 3, generator=generator) * 2 - 1,
        sizes_m=torch.rand(rooms, objects, 3, generator=generator) + 0.2,
        completeness_logits=torch.zeros(rooms, objects),
        bevels=torch.full((rooms, objects, 2), 0.3),
    )
    return scenes, SceneViews(
        room_index=torch.arange(rooms),
        object_class=torch.ones(rooms, objects, dtype=torch.int64),
        is_object=torch.ones(rooms, objects, dtype=torch.bool),
        world_to_camera=poses.float().expand(rooms, views, 4, 4),
        intrinsics=lens.expand(rooms, views, 3, 3),
        boxes=torch.zeros(rooms, views, objects, 4),
        visible=empty,
        sides_clear=empty[..., None].expand(-1, -1, -1, 4),
        image_size=(60, 80),
    )


@pytest.mark.parametrize("box_from", ["mesh", "proxy"])
def test_the_shape_stage_takes_boxes_from_where_it_is_told(seen, tmp_path, box_from):
    config = tiny_config(tmp_path, shape__box_from=box_from, shape__proxy="ellipsoid")
    prior = config.build_prior()
    scenes = prior(config.build_latents(2).weight)
    found = seen_boxes(scenes, seen[1], config.shape.proxy, config.shape.box_from)
    if box_from == "proxy":
        expected = seen_boxes(scenes, seen[1], "ellipsoid")
    else:
        views = seen[1]
        expected = boxes_of_points(
            scenes.vertices_m, views.world_to_camera, views.intrinsics, views.image_size
        )
    # Of three objects; the fourth prediction is matched to none.
    assert_close(found.boxes[:, :, :3], expected.boxes[:, :, :3], rtol=0, atol=0)
    assert torch.equal(found.in_frustum[:, :, :3], expected.in_frustum[:, :, :3])


@pytest.mark.parametrize("box_from", ["mesh", "proxy"])
def test_predictions_that_are_matched_to_nothing_are_not_projected(seen, box_from):
    scenes, views = seen
    generator = torch.Generator().manual_seed(1)
    scenes = replace(scenes, vertices_m=torch.rand(2, 3, 9, 3, generator=generator))
    first = torch.tensor([[True, True], [True, False]])
    fewer = replace(
        views, object_class=views.object_class[:, :2], is_object=first,
        boxes=views.boxes[:, :, :2], visible=views.visible[:, :, :2],
        sides_clear=views.sides_clear[:, :, :2],
    )  # fmt: skip
    for proxy in ("ellipsoid", "beveled_box"):
        some, every = (seen_boxes(scenes, of, proxy, box_from) for of in (fewer, views))
        for found, wanted in zip(some, every, strict=True):
            # The same operations on other strides: the last bits may differ.
            assert_close(found[0, :, :2], wanted[0, :, :2])
            assert_close(found[1, :, :1], wanted[1, :, :1])
            assert not found[0, :, 2].any() and not found[1, :, 1:].any()
        assert every.in_frustum.all()
