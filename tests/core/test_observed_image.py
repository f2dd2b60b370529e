"""Single images out of shards."""

import numpy as np
import pytest
import torch

from sceneprior.core.observations import RoomViews, thinned_intrinsics
from sceneprior.core.shards import Shard, list_shards
from sceneprior.core.views import as_views, image_of_room, images_of_split


@pytest.fixture(scope="module")
def room(toy_shards) -> RoomViews:
    with Shard(list_shards(toy_shards, "test")[0]) as shard:
        return shard.read_room(shard.room_ids[0], images=True)


def test_only_what_the_view_shows_remains(room):
    view = int(np.flatnonzero(~room.visible.all(axis=1) & room.visible.any(axis=1))[0])
    image = image_of_room(room, view, "front3d_bedroom")
    rows = np.flatnonzero(room.visible[view])
    assert image.rows == tuple(rows)
    for k, row in enumerate(rows):
        mask = image.instance_ids == k + 1
        np.testing.assert_array_equal(mask, room.instance_ids[view] == row + 1)
        assert image.object_class[k] == room.object_class[row]
        np.testing.assert_array_equal(image.boxes[k], room.boxes[view, row])
    assert image.instance_ids.max() == len(rows)


def test_a_batch_is_one_view_a_room(toy_shards):
    images, _ = images_of_split(toy_shards, "test", 0)
    views = as_views(images, 4)
    counts = [len(image.object_class) for image in images]
    assert views.is_object.sum(dim=1).tolist() == counts
    assert views.visible.shape == (4, 1, max(counts))
    assert views.instance_ids.shape == (4, 1, 18, 24)
    for row, image in enumerate(images):
        sampled = torch.from_numpy(image.instance_ids[2::4, 2::4].astype(np.int32))
        assert torch.equal(views.instance_ids[row, 0], sampled)


@pytest.mark.parametrize("step", [1, 2, 3, 4, 6])
def test_cameras_of_masks_are_those_of_thinned_images(toy_shards, step):
    images, _ = images_of_split(toy_shards, "test", 0)
    views = as_views(images, step)
    thin = np.array([thinned_intrinsics(image.intrinsics, step) for image in images])
    np.testing.assert_allclose(views.mask_intrinsics()[:, 0], thin, rtol=1e-6)
    pooled = np.diag([0.5, 0.5, 1]) @ thin
    np.testing.assert_allclose(views.mask_intrinsics(2)[:, 0], pooled, rtol=1e-6)
