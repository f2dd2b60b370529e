"""The transformer: order does not matter, unrolling is stepping, and a slow twin agrees."""

import pytest
import torch
from references.scene_decoder import next_object, next_object_loop, unroll
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.paper.transformer import SceneTransformer, TransformerConfig

# Sums in another order: a few roundings of numbers around 1.
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}


def decoder(dtype=torch.float64, dropout=0.0, seed=0, width=24, heads=3) -> SceneTransformer:
    torch.manual_seed(seed)
    made = SceneTransformer(
        width, TransformerConfig(heads=heads, hidden=40, dropout=dropout), max_objects=6
    ).to(dtype)
    with torch.no_grad():  # biases and norms as different from their start as after training
        for parameter in made.parameters():
            parameter += 0.2 * torch.randn_like(parameter)
    return made


def inputs(torch_rng, dtype=torch.float64, rooms=3, objects=6, width=24):
    z = F.normalize(torch.randn(rooms, width, generator=torch_rng, dtype=dtype), dim=-1)
    return z, torch.randn(rooms, objects, width, generator=torch_rng, dtype=dtype)


@pytest.mark.parametrize("dtype", TOLERANCE)
def test_the_next_object_does_not_depend_on_the_order_of_those_before(torch_rng, dtype):
    model = decoder(dtype).eval()
    z, previous = inputs(torch_rng, dtype)
    wanted = next_object(model, z, previous)
    for seed in range(5):
        order = torch.randperm(6, generator=torch.Generator().manual_seed(seed))
        shuffled = next_object(model, z, previous[:, order])
        assert_close(shuffled, wanted, rtol=0, atol=TOLERANCE[dtype])
    # ... but on what they are: one object more or another one changes the answer.
    assert (next_object(model, z, previous[:, :5]) - wanted).abs().max() > 1e-3
    assert (next_object(model, z, previous.flip(0)) - wanted).abs().max() > 1e-3


@pytest.mark.parametrize("dtype", TOLERANCE)
def test_unrolling_with_a_cache_is_asking_step_by_step(torch_rng, dtype):
    model = decoder(dtype).eval()
    z, _ = inputs(torch_rng, dtype)
    unrolled = model(z, 7)
    features = z.new_zeros(3, 0, 24)
    for _ in range(7):
        newest = next_object(model, z, features)
        features = torch.cat([features, newest.unsqueeze(1)], dim=1)
    assert unrolled.shape == (3, 7, 24)
    # An error of one step goes through all the later ones.
    assert_close(unrolled, features, rtol=0, atol=10 * TOLERANCE[dtype])
    assert_close(model(z, 3), unrolled[:, :3], rtol=0, atol=10 * TOLERANCE[dtype])


def test_objects_that_no_room_needs_are_left_out(torch_rng):
    model = decoder(torch.float64).eval()
    z, _ = inputs(torch_rng, rooms=4)
    needed = torch.tensor([2, 6, 0, 3])
    found, whole = model(z, 6, needed), model(z, 6)
    taken = torch.arange(6) < needed[:, None]
    assert_close(found[taken], whole[taken], rtol=0, atol=1e-12)
    assert not found[~taken].any()
    assert not model(z, 6, torch.zeros(4, dtype=torch.int64)).any()


def test_the_slow_twin_says_the_same(torch_rng):
    model = decoder().eval()
    z, previous = inputs(torch_rng, objects=4)
    key_bias = torch.randn(24, generator=torch_rng, dtype=torch.float64)
    with torch.no_grad():
        by_hand = next_object_loop(model, z, previous, key_bias)
        assert_close(next_object(model, z, previous), by_hand, rtol=0, atol=1e-12)
        first = next_object_loop(model, z, previous[:, :0], key_bias)
        assert_close(model(z, 1)[:, 0], first, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_a_training_step_has_the_gradients_of_plain_layers(torch_rng, dtype, tolerance):
    model = decoder(dtype, dropout=0.1).train()
    z, weights = inputs(torch_rng, dtype)
    z.requires_grad_()
    parameters = dict(model.named_parameters()) | {"z": z}
    found = []
    for features in (lambda: model(z, 6), lambda: unroll(model, z, 6)):
        torch.manual_seed(3)  # both set the same values to zero
        x = features()
        gradients = torch.autograd.grad((x * weights).sum(), list(parameters.values()))
        found.append((x.detach(), dict(zip(parameters, gradients, strict=True))))
    (ours, own), (plain, wanted) = found
    assert_close(ours, plain, rtol=0, atol=10 * TOLERANCE[dtype])
    for name, gradient in wanted.items():
        scale = float(gradient.norm())
        # ... up to rounding, relative to the whole gradient of the parameter.
        assert float((own[name] - gradient).norm()) <= tolerance * max(scale, 1), name


def test_rooms_that_need_fewer_objects_have_the_same_gradients(torch_rng):
    model = decoder(torch.float64).eval()
    z, weights = inputs(torch_rng, rooms=4)
    needed = torch.tensor([2, 6, 0, 3])
    taken = (torch.arange(6) < needed[:, None]).unsqueeze(-1)
    parameters = list(model.parameters())
    found, wanted = (
        torch.autograd.grad((features * weights * taken).sum(), parameters)
        for features in (model(z, 6, needed), unroll(model, z, 6))
    )
    assert_close(found, wanted, rtol=0, atol=1e-11)


def test_every_weight_has_a_gradient_that_gradcheck_confirms(torch_rng):
    model = decoder(width=8, heads=2).eval()
    z = F.normalize(torch.randn(1, 8, generator=torch_rng, dtype=torch.float64), dim=-1)
    model(z, 3).pow(3).sum().backward()
    unused = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert unused == []
    assert torch.autograd.gradcheck(lambda x: model(x, 3), (z.requires_grad_(),), atol=1e-6)
