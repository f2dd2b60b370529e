"""Inputs of single-view networks: crops, rays, and a frame that moves and turns with the room."""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from sceneprior.baselines.single_view.detections import CROP, detections_of, some_views
from sceneprior.core.boxes import turn_vectors
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.views import SceneViews


@pytest.fixture(scope="module")
def views(toy_shards) -> SceneViews:
    """Four views of each of five toy rooms."""
    data = ViewDataset(toy_shards, "train", views_per_room=4, mask_step=2, seed=1)
    return data.__getitems__([(row, 0) for row in range(5)])


def moved(views: SceneViews, quarter: int, shift_m: tuple[float, float]) -> SceneViews:
    """Rooms and cameras together turned by quarters, then moved along the floor."""
    quarters = torch.full((len(views.room_index),), quarter)
    poses = views.world_to_camera
    turned = turn_vectors(poses[..., :3], quarters)
    shift = torch.tensor([shift_m[0], 0.0, shift_m[1]])
    offset = poses[..., 3:].clone()
    offset[..., :3, 0] -= turned[..., :3, :] @ shift
    return replace(views, world_to_camera=torch.cat([turned, offset], dim=-1))


def test_a_crop_shows_the_mask_and_those_beside_it(views):
    found = detections_of(views)
    own, others, inside = found.crops[:, 0], found.crops[:, 1], found.crops[:, 2]
    assert set(found.crops[:, :3].unique().tolist()) == {0.0, 1.0}
    assert not (own * others).any() and not (own * (1 - inside)).any()
    # The box is the middle half of the crop along each side, once the margins are a quarter each.
    sides = (found.boxes[:, 2:] - found.boxes[:, :2]).amin(dim=-1)
    large = sides > 0.2
    low, high = round(CROP / 6), round(CROP * 5 / 6)
    within = own[:, low:high, low:high].sum(dim=(1, 2))
    assert (within[large] >= 0.9 * own[large].sum(dim=(1, 2))).all()
    lengths = found.crops[:, 3:].norm(dim=1)
    assert_close(lengths, torch.ones_like(lengths), rtol=0, atol=1e-5)


def test_what_is_told_moves_and_turns_with_the_room(views):
    plain = detections_of(views)
    for quarter in range(4):
        other = detections_of(moved(views, quarter, (3.0, -2.0)))
        assert_close(other.crops, plain.crops, rtol=0, atol=1e-5)
        assert_close(other.numbers, plain.numbers, rtol=0, atol=1e-5)
        offsets = torch.full((len(plain), 2), 0.1)
        distances = torch.linspace(1, 4, len(plain))
        before, after = (each.centers_at(offsets, distances) for each in (plain, other))
        turns = torch.full((len(plain),), quarter)
        wanted = turn_vectors(before, turns) + torch.tensor([3.0, 0.0, -2.0])
        assert_close(after, wanted, rtol=0, atol=1e-4)


def test_offsets_and_distances_are_where_centers_are(views):
    found = detections_of(views)
    offsets = torch.linspace(-0.4, 0.4, 2 * len(found)).reshape(-1, 2)
    distances = torch.linspace(0.8, 6, len(found))
    again = found.offsets_and_distances(found.centers_at(offsets, distances))
    assert again[2].all()
    assert_close(again[0], offsets, rtol=0, atol=1e-3)
    assert_close(again[1], distances, rtol=0, atol=1e-4)
    behind = found.eye_m - (found.centers_at(offsets, distances) - found.eye_m)
    offsets, _, ahead = found.offsets_and_distances(behind)
    assert not ahead.any() and not offsets.any()


def test_a_view_without_a_mask_is_no_detection(views):
    blank = replace(some_views(views, slice(1)), visible=torch.zeros_like(views.visible[:, :1]))
    found = detections_of(blank)
    assert len(found) == 0 and found.padded(found.boxes).shape == (0, 0, 4)


def test_values_go_to_their_objects_and_to_their_images(views):
    found = detections_of(some_views(views, slice(2, 3)))
    values = torch.arange(1.0, 1 + len(found)).unsqueeze(-1)
    rooms, objects = views.is_object.shape
    spread = found.of_objects(values, rooms, objects)
    assert torch.equal(spread[..., 0] > 0, views.visible[:, 2])
    assert torch.equal(found.padded(values)[found.image, found.slot], values)
