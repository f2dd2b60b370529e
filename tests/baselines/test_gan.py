"""The GAN: semantic maps of cameras and of decoded scenes, its losses and its discriminator."""

import itertools

import pytest
import torch
from torch.testing import assert_close

from sceneprior.baselines.semantic_maps import (
    POOLING,
    MapDiscriminator,
    choices,
    compose_maps,
    kept_share,
    observed_maps,
)
from sceneprior.core.classes import VOID
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.losses import kept_objects

CLASSES = 22


@pytest.fixture(scope="module")
def views(toy_shards):
    return ViewDataset(toy_shards, "train", views_per_room=3, mask_step=2).__getitems__(
        [(row, 0) for row in range(4)]
    )


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


@pytest.mark.parametrize("convention", ("first_n", "stop"))
def test_the_share_kept_is_the_chance_that_a_scene_goes_on(convention, torch_rng):
    scores = torch.rand(2, 5, generator=torch_rng, dtype=torch.float64)
    share = kept_share(scores, convention)
    for room in range(2):
        wanted = torch.zeros(5, dtype=torch.float64)
        for words in itertools.product((0, 1), repeat=5):  # every way to say yes and no
            said = torch.tensor(words, dtype=torch.float64)
            chance = (said * scores[room] + (1 - said) * (1 - scores[room])).prod()
            wanted += chance * kept_objects(said[None] - 0.5, convention)[0]
        assert_close(share[room], wanted, rtol=0, atol=1e-12)
    inputs = scores[:, :3].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: kept_share(x, convention), inputs)


def test_the_order_of_views_means_nothing_to_the_discriminator(views):
    torch.manual_seed(0)
    maps, judge = observed_maps(views, CLASSES), MapDiscriminator(CLASSES).eval()
    (patches, room), (patches_turned, room_turned) = judge(maps), judge(maps.flip(1))
    assert_close(room_turned, room, rtol=0, atol=1e-5)
    assert_close(patches_turned.flip(1), patches, rtol=0, atol=1e-5)
