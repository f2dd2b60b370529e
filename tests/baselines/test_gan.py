"""The GAN: semantic maps of cameras and of decoded scenes, its losses and its discriminator."""

from pathlib import Path

import pytest
import torch
import trimesh
from torch.testing import assert_close

from sceneprior.baselines.semantic_maps import (
    POOLING,
    MapDiscriminator,
    choices,
    compose_maps,
    observed_maps,
    rendered_maps,
)
from sceneprior.core.classes import VOID
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.proxies import place
from sceneprior.core.shards import iterate_rooms
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.losses import kept_objects

CLASSES = 22
BOX = trimesh.creation.box()
CORNERS, FACES = torch.tensor(2 * BOX.vertices).float(), torch.tensor(BOX.faces)
SURE = 9.0


@pytest.fixture(scope="module")
def views(toy_shards):
    return ViewDataset(toy_shards, "train", views_per_room=3, mask_step=2).__getitems__(
        [(row, 0) for row in range(4)]
    )


def true_scenes(folder: Path, rooms: int, objects: int = 6) -> DecodedScenes:
    """The toy rooms themselves, as a prior that knows everything would decode them."""
    logits = torch.zeros(rooms, objects, CLASSES)
    complete = torch.full((rooms, objects), -SURE)
    centers, sizes = torch.zeros(rooms, objects, 3), torch.ones(rooms, objects, 3)
    for row, (shard, room_id) in zip(range(rooms), iterate_rooms(folder, "train"), strict=False):
        truth = shard.read_ground_truth(room_id)
        count = min(objects, len(truth.object_class))
        logits[row, torch.arange(count), torch.as_tensor(truth.object_class[:count]).long()] = SURE
        centers[row, :count] = torch.as_tensor(truth.centers_m[:count])
        sizes[row, :count] = torch.as_tensor(truth.sizes_m[:count])
        complete[row, :count] = SURE
    meshes = place(CORNERS.expand(rooms, objects, -1, -1), centers, sizes)
    return DecodedScenes(logits, centers, sizes, complete, None, meshes)


def test_observed_maps_are_the_shares_of_classes_in_each_pixel(views):
    maps = observed_maps(views, CLASSES)
    ids = views.instance_ids
    rooms, seen, height, width = ids.shape
    assert maps.shape == (rooms, seen, CLASSES, height // POOLING, width // POOLING)
    wanted = torch.zeros_like(maps)
    for room in range(rooms):
        for view in range(seen):
            for row in range(height // POOLING * POOLING):
                for column in range(width // POOLING * POOLING):
                    item = int(ids[room, view, row, column])
                    label = int(views.object_class[room, item - 1]) if item else VOID
                    wanted[room, view, label, row // POOLING, column // POOLING] += 1 / POOLING**2
    assert torch.equal(maps, wanted)
    assert 0 < maps[:, :, VOID].mean() < 1


def test_the_true_room_looks_as_it_was_seen(views, toy_shards):
    """Boxes drawn into their own cameras: the two ways to a map meet."""
    scenes = true_scenes(toy_shards, 4)
    drawn = drawn_maps(scenes, views)
    seen = observed_maps(views, CLASSES)
    assert drawn.shape == seen.shape
    assert_close(drawn.sum(dim=2), torch.ones_like(drawn[:, :, 0]), rtol=0, atol=1e-5)
    # They part at edges alone: of the pixels that show one class alone, nearly all agree.
    plain = (seen.amax(dim=2) == 1) & whole(scenes, views)[..., None, None]
    assert plain.float().mean() > 0.1
    agree = (drawn.argmax(dim=2) == seen.argmax(dim=2))[plain].float().mean()
    assert agree > 0.995
    assert (drawn - seen).abs().mean() < 0.01


def drawn_maps(scenes: DecodedScenes, views) -> torch.Tensor:
    return rendered_maps(scenes, FACES, views, *choices(scenes, "first_n"), "fast")


def whole(scenes: DecodedScenes, views) -> torch.Tensor:
    """Views of which no object has a corner behind the camera; its faces would be left out."""
    corners = torch.cat([scenes.vertices_m, torch.ones_like(scenes.vertices_m[..., :1])], dim=-1)
    ahead = torch.einsum("rvd,rkcd->rvkc", views.world_to_camera[:, :, 2], corners)
    there = (scenes.completeness_logits > 0)[:, None, :, None]
    return ((ahead > 0.1) | ~there).flatten(2).all(dim=-1)


def test_laying_over_is_the_product_of_what_nearer_objects_leave(torch_rng):
    rooms, views, objects, classes = 2, 2, 4, 5
    double = {"generator": torch_rng, "dtype": torch.float64}
    coverage = torch.rand(rooms, views, objects, 3, 2, **double)
    depth = torch.rand(rooms, views, objects, 3, 2, **double)
    kept = torch.rand(rooms, objects, **double)
    shares = torch.rand(rooms, objects, classes, **double).softmax(dim=-1)
    maps = compose_maps(coverage, depth, kept, shares)
    for place_ in torch.cartesian_prod(*map(torch.arange, (rooms, views, 3, 2))).tolist():
        room, view, row, column = place_
        left, wanted = 1.0, torch.zeros(classes, dtype=torch.float64)
        for k in depth[room, view, :, row, column].argsort().tolist():
            alpha = kept[room, k] * coverage[room, view, k, row, column]
            wanted += left * alpha * shares[room, k]
            left *= 1 - alpha
        wanted[VOID] += left
        assert_close(maps[room, view, :, row, column], wanted, rtol=0, atol=1e-12)


def test_gradients_of_laying_over_pass_gradcheck(torch_rng):
    double = {"generator": torch_rng, "dtype": torch.float64}
    inputs = (
        torch.rand(1, 1, 3, 2, 2, **double).requires_grad_(),
        torch.rand(1, 1, 3, 2, 2, **double),
        torch.rand(1, 3, **double).requires_grad_(),
        torch.rand(1, 3, 4, **double).softmax(dim=-1).requires_grad_(),
    )
    assert torch.autograd.gradcheck(compose_maps, inputs)


def test_choices_are_hard_and_their_gradients_soft(torch_rng):
    numbers = torch.randn(2, 3, 6, generator=torch_rng, dtype=torch.float64)
    labels, complete = (part.requires_grad_() for part in (numbers[..., :5], numbers[..., 5]))
    scenes = DecodedScenes(labels, numbers[..., :3], numbers[..., :3], complete)
    weights = torch.randn(2, 3, 5, generator=torch_rng, dtype=torch.float64)
    kept, classes = choices(scenes, "first_n")
    assert torch.equal(classes.detach().round(), torch.nn.functional.one_hot(labels.argmax(-1), 5))
    assert torch.equal(kept.detach() > 0.5, kept_objects(complete, "first_n"))
    (wanted,) = torch.autograd.grad((labels.softmax(dim=-1) * weights).sum(), labels)
    (got,) = torch.autograd.grad((classes * weights).sum(), labels)
    assert_close(got, wanted, rtol=0, atol=1e-15)


def test_the_order_of_views_means_nothing_to_the_discriminator(views):
    torch.manual_seed(0)
    maps, judge = observed_maps(views, CLASSES), MapDiscriminator(CLASSES).eval()
    (patches, room), (patches_turned, room_turned) = judge(maps), judge(maps.flip(1))
    assert_close(room_turned, room, rtol=0, atol=1e-5)
    assert_close(patches_turned.flip(1), patches, rtol=0, atol=1e-5)
