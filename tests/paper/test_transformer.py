"""The transformer: order does not matter, unrolling is stepping, slow twins agree, with the paper's
parts and with the released code's; dropout and repeated layers alone."""

import pytest
import torch
from references.scene_decoder import next_object, next_object_loop, unroll
from torch import nn
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.paper.transformer import (
    RepeatedLinear,
    SceneTransformer,
    TransformerConfig,
    dropout,
)

# Sums in another order: a few roundings of numbers around 1.
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}
RELEASED = {"final_norm": True, "query_self_attention": True, "step_mlps": True}
PARTS = pytest.mark.parametrize("parts", [{}, RELEASED], ids=["paper", "released"])


def decoder(dtype=torch.float64, dropout=0.0, width=24, heads=3, parts=None) -> SceneTransformer:
    torch.manual_seed(0)
    config = TransformerConfig(heads=heads, hidden=40, dropout=dropout, **(parts or {}))
    made = SceneTransformer(width, config, max_objects=7).to(dtype)
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


@PARTS
@pytest.mark.parametrize("dtype", TOLERANCE)
def test_unrolling_with_a_cache_is_asking_step_by_step(torch_rng, dtype, parts):
    model = decoder(dtype, parts=parts).eval()
    z, _ = inputs(torch_rng, dtype)
    unrolled = model(z, 7)
    features = z.new_zeros(3, 0, 24)
    for _ in range(7):
        newest = next_object(model, z, features)
        features = torch.cat([features, newest.unsqueeze(1)], dim=1)
    # An error of one step goes through all the later ones.
    assert_close(unrolled, features, rtol=0, atol=10 * TOLERANCE[dtype])
    assert_close(model(z, 3), unrolled[:, :3], rtol=0, atol=10 * TOLERANCE[dtype])


def test_objects_that_no_room_needs_are_left_out_of_features_and_gradients(torch_rng):
    model = decoder().eval()
    z, weights = inputs(torch_rng, rooms=4)
    needed = torch.tensor([2, 6, 0, 3])
    found, whole = model(z, 6, needed), unroll(model, z, 6)
    taken = torch.arange(6) < needed[:, None]
    assert_close(found[taken], whole[taken], rtol=0, atol=1e-12)
    assert not found[~taken].any()
    own, wanted = (
        torch.autograd.grad((x * weights * taken.unsqueeze(-1)).sum(), list(model.parameters()))
        for x in (found, whole)
    )
    assert_close(own, wanted, rtol=0, atol=1e-11)
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


@PARTS
def test_every_weight_has_a_gradient_that_gradcheck_confirms(torch_rng, parts):
    model = decoder(width=8, heads=2, parts=parts).eval()
    z = F.normalize(torch.randn(1, 8, generator=torch_rng, dtype=torch.float64), dim=-1)
    model(z, 7).pow(3).sum().backward()
    unused = [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()]
    assert unused == []
    assert torch.autograd.gradcheck(lambda x: model(x, 3), (z.requires_grad_(),), atol=1e-6)


def test_a_step_is_torchs_encoder_and_decoder_layer_their_norms_and_the_steps_mlp(torch_rng):
    """The released network as torch.nn builds it, with our weights."""
    model, width = decoder(parts=RELEASED).eval(), 24
    torch.manual_seed(1)
    shape = {"dim_feedforward": 40, "activation": "gelu", "batch_first": True}
    encoder = nn.TransformerEncoderLayer(width, 3, **shape).double().eval()
    lower = nn.TransformerDecoderLayer(width, 3, **shape).double().eval()
    query, key, value = model.decoder_query, model.decoder_key, model.decoder_value
    own = model.query
    with torch.no_grad():
        for theirs, ours in (
            (encoder.self_attn.in_proj_weight, model.encoder_qkv.weight),
            (encoder.self_attn.in_proj_bias, model.encoder_qkv.bias),
            (lower.self_attn.in_proj_weight[2 * width :], own.value.weight),
            (lower.self_attn.in_proj_bias[2 * width :], own.value.bias),
            (lower.multihead_attn.in_proj_weight, torch.cat([query.weight, key, value.weight])),
            (
                lower.multihead_attn.in_proj_bias,
                torch.cat([query.bias, torch.ones(width).double(), value.bias]),
            ),
        ):
            theirs.copy_(ours)
        for theirs, ours in (
            (encoder.self_attn.out_proj, model.encoder_out),
            (encoder.linear1, model.encoder_ff.expand),
            (encoder.linear2, model.encoder_ff.contract),
            (encoder.norm1, model.encoder_norm),
            (encoder.norm2, model.encoder_ff.norm),
            (lower.self_attn.out_proj, own.out),
            (lower.multihead_attn.out_proj, model.decoder_out),
            (lower.linear1, model.decoder_ff.expand),
            (lower.linear2, model.decoder_ff.contract),
            (lower.norm1, own.norm),
            (lower.norm2, model.decoder_norm),
            (lower.norm3, model.decoder_ff.norm),
        ):
            theirs.load_state_dict(ours.state_dict())
        z, previous = inputs(torch_rng, objects=4)
        tokens = torch.cat([model.start.expand(3, 1, -1), previous], dim=1)
        context = model.encoder_end(encoder(tokens))
        answer = model.decoder_end(lower((z * width**0.5)[:, None], context))[:, 0]
        wanted = model.output.mlps[4](answer)
        assert_close(next_object(model, z, previous), wanted, rtol=0, atol=1e-12)
        assert (answer - wanted).abs().max() > 0.1


def test_the_released_steps_end_in_a_relu_and_its_start_token_is_a_unit_normal(torch_rng):
    model = decoder(parts=RELEASED).eval()
    features = model(inputs(torch_rng)[0], 7)
    assert (features == 0).any(dim=-1).all() and (features > 0).any(dim=-1).all()
    assert not (features < 0).any()
    for unit, deviation in ((True, 1.0), (False, 1 / 64)):
        torch.manual_seed(0)
        start = TransformerConfig(unit_start=unit).build(4096, 1).start
        assert float(start.detach().std()) == pytest.approx(deviation, rel=0.06)  # 5 sigma


@pytest.mark.parametrize("p", [0.1, 0.7])
def test_each_number_is_dropped_alone_and_as_often_as_asked(p):
    torch.manual_seed(0)
    times, numbers = 4000, 60
    kept = torch.stack([dropout(torch.ones(6, 10), p) for _ in range(times)]).flatten(1)
    assert_close(kept.unique(), torch.tensor([0, 1 / (1 - p)]))
    dropped = (kept == 0).double()
    sigma = (p * (1 - p) / times) ** 0.5
    # 60 shares, then 1,770 pairs: 5 sigma of each leave one failure in a thousand seeds.
    assert (dropped.mean(dim=0) - p).abs().max() < 5 * sigma
    pairs = torch.corrcoef(dropped.T) - torch.eye(numbers)
    assert pairs.abs().max() < 5 / times**0.5
    # The number of hits is random, too: a fixed one would leave too little spread of the total.
    spread = dropped.sum(dim=1).var() / (numbers * p * (1 - p))
    assert abs(spread - 1) < 5 * (2 / times) ** 0.5


ROWS = (2, 0, 5, 3)


def layers(torch_rng, bias=True):
    """Two groups of 4 inputs and 3 outputs, and an input for each use."""
    shapes = [(2, 4, 3), (2, 3), *((2, rows, 4) for rows in ROWS)]
    weight, biases, *inputs = (
        torch.randn(shape, generator=torch_rng, dtype=torch.float64, requires_grad=True)
        for shape in shapes
    )
    return weight, biases if bias else None, inputs


def loss_of(outputs):
    return sum((k * y.pow(3)).sum() for k, y in enumerate(outputs, 1))


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("used", [len(ROWS), 2])
def test_outputs_and_gradients_are_those_of_plain_layers(torch_rng, bias, used):
    weight, biases, inputs = layers(torch_rng, bias)
    leaves = [weight, *inputs[:used]] + ([biases] if bias else [])
    plain = [x @ weight + (biases[:, None] if bias else 0) for x in inputs[:used]]
    wanted = torch.autograd.grad(loss_of(plain), leaves)
    layer = RepeatedLinear(weight, biases, ROWS)
    found = [layer(x) for x in inputs[:used]]
    assert_close(found, plain, rtol=0, atol=1e-13)
    # Twice, and only in part in between: no gradient is left over from another pass.
    for _ in range(2):
        gradients = torch.autograd.grad(loss_of(found), leaves, retain_graph=True)
        assert_close(gradients, wanted, rtol=0, atol=1e-12)
        partial = torch.autograd.grad(loss_of(found[:1]), leaves[:1], retain_graph=True)
        wanted_part = torch.autograd.grad(loss_of([inputs[0] @ weight + (
            biases[:, None] if bias else 0)]), leaves[:1])  # fmt: skip
        assert_close(partial, wanted_part, rtol=0, atol=1e-12)


def test_gradcheck_confirms_the_gradients(torch_rng):
    weight, biases, inputs = layers(torch_rng)

    def outputs(weight, biases, *inputs):
        layer = RepeatedLinear(weight, biases, ROWS)
        first = layer(inputs[0])
        # A later input depends on an earlier output, as in the transformer.
        return first, *(layer(x + first.sum(dim=1, keepdim=True).mean()) for x in inputs[1:])

    assert torch.autograd.gradcheck(outputs, (weight, biases, *inputs))
