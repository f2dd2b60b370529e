"""Boxes, classes and deformed templates: where they start, and what they can never be."""

import math

import pytest
import torch
from torch.testing import assert_close

from sceneprior.paper.config import PaperModel
from sceneprior.paper.decoders import (
    LayoutDecoder,
    SeparateHeads,
    ShapeDecoder,
    ShapeDecoderConfig,
    above_floor,
    fill_unit_box,
)
from sceneprior.paper.prior import ScenePrior, SphereConfig
from sceneprior.paper.transformer import TransformerConfig


@pytest.mark.parametrize("heads", ["joint", "separate"])
def test_before_training_all_objects_stand_near_the_floor_centre(torch_rng, heads):
    torch.manual_seed(0)
    model = LayoutDecoder(64, 22, heads=heads)
    # Features leave a LayerNorm: about N(0, 1).
    layout, _ = model(torch.randn(8, 13, 64, generator=torch_rng))
    assert layout.centers_m[..., [0, 2]].abs().max() < 0.3
    assert_close(layout.sizes_m, torch.full((8, 13, 3), 0.7), rtol=0, atol=0.1)
    bottom = layout.centers_m[..., 1] - layout.sizes_m[..., 1] / 2
    assert bottom.min() >= 0 and bottom.max() < 0.3
    # They are not all alike: objects can part.
    assert layout.centers_m.std(dim=1).min() > 1e-3


@pytest.mark.parametrize("heads", ["joint", "separate"])
def test_no_box_reaches_below_the_floor_whatever_the_weights(torch_rng, heads):
    torch.manual_seed(0)
    model = LayoutDecoder(16, 5, heads=heads).double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(0, 2, generator=torch_rng)
    layout, _ = model(torch.randn(50, 10, 16, generator=torch_rng, dtype=torch.float64))
    bottom = layout.centers_m[..., 1] - layout.sizes_m[..., 1] / 2
    assert (bottom >= -1e-9).all() and (bottom.abs() < 1e-9).any() and (bottom > 1).any()
    assert (layout.sizes_m >= 0).all()


def test_separate_heads_read_mlp1_without_a_relu_and_completeness_reads_the_feature(torch_rng):
    torch.manual_seed(0)
    model = SeparateHeads(16, 8, 4).double()
    shared = torch.randn(2, 3, 8, generator=torch_rng, dtype=torch.float64)
    features = torch.randn(2, 3, 16, generator=torch_rng, dtype=torch.float64)
    out = model(shared, features)
    assert out.shape == (2, 3, 11)
    for room in range(2):
        for item in range(3):
            x = shared[room, item]
            wanted = [*(model.classes.weight @ x + model.classes.bias)]
            for first, _, last in model.coordinates:
                hidden = (first.weight @ x + first.bias).clamp(min=0)
                wanted.append(last.weight[0] @ hidden + last.bias[0])
            first, _, last = model.completeness
            assert first.out_features == 4, "128 of 512"
            hidden = (first.weight @ features[room, item] + first.bias).clamp(min=0)
            wanted.append(last.weight[0] @ hidden + last.bias[0])
            assert_close(out[room, item], torch.stack(wanted), rtol=0, atol=1e-12)


def test_the_layout_is_what_supplement_a_says(torch_rng):
    """MLP2(MLP1(x)), then SoftPlus on sizes and ReLU on y, one object at a time."""
    torch.manual_seed(1)
    model = LayoutDecoder(6, 4).double()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter += 0.3 * torch.randn(parameter.shape, generator=torch_rng).double()
    x = torch.randn(2, 3, 6, generator=torch_rng, dtype=torch.float64)
    layout, shared = model(x)
    one, two = model.mlp1, model.mlp2
    for room in range(2):
        for item in range(3):
            hidden = (one[0].weight @ x[room, item] + one[0].bias).clamp(min=0)
            feature = one[2].weight @ hidden + one[2].bias
            assert_close(shared[room, item], feature)
            hidden = (two[1].weight @ feature.clamp(min=0) + two[1].bias).clamp(min=0)
            out = (two[3].weight @ hidden + two[3].bias).tolist()
            sizes = [math.log1p(math.exp(value)) for value in out[7:10]]
            center = [out[4], max(out[5], 0) + sizes[1] / 2, out[6]]
            found = [
                *layout.class_logits[room, item].tolist(),
                *layout.centers_m[room, item].tolist(),
                *layout.sizes_m[room, item].tolist(),
                layout.completeness_logits[room, item].item(),
            ]
            assert_close(torch.tensor(found), torch.tensor([*out[:4], *center, *sizes, out[10]]))


def test_above_the_floor_is_relu_and_keeps_the_gradient_that_lifts():
    y = torch.tensor([-1.0, -1.0, 0.0, 2.0, 2.0], requires_grad=True)
    above = above_floor(y)
    assert torch.equal(above, y.relu())
    upstream = torch.tensor([-3.0, 3.0, -3.0, -3.0, 3.0])
    (above * upstream).sum().backward()
    assert y.grad.tolist() == [-3.0, 0.0, -3.0, -3.0, 3.0]


def test_fit_box_fills_the_unit_box_exactly(torch_rng):
    vertices = torch.randn(5, 4, 30, 3, generator=torch_rng) * torch.tensor([3, 1, 0.1])
    fitted = fill_unit_box(vertices + 2)
    one = torch.ones(5, 4, 3)
    atol = 4 * torch.finfo(torch.float32).eps * 10  # a few roundings of numbers up to 10
    assert_close(fitted.amin(dim=-2), -one, rtol=0, atol=atol)
    assert_close(fitted.amax(dim=-2), one, rtol=0, atol=atol)
    # Scaled and moved along the axes, nothing else: along each axis the order stays.
    assert torch.equal(fitted.argsort(dim=-2), vertices.argsort(dim=-2))


def test_the_split_first_layer_is_the_concatenated_one(torch_rng):
    """Equation 6 as written, MLP3(Concat[feature, v]), one vertex at a time."""
    torch.manual_seed(0)
    model = ShapeDecoder(6, ShapeDecoderConfig(width=8, level=0)).double()
    features = torch.randn(2, 3, 6, generator=torch_rng, dtype=torch.float64)
    weight = torch.cat([model.from_feature.weight, model.from_vertex.weight], dim=1)
    meshes = model(features)
    for room in range(2):
        for item in range(3):
            code = model.reduce(features[room, item])
            for k, vertex in enumerate(model.template):
                first = weight @ torch.cat([code, vertex]) + model.from_feature.bias
                wanted = vertex + model.offsets(first)
                assert_close(meshes[room, item, k], wanted, rtol=0, atol=1e-12)


def small_prior() -> ScenePrior:
    torch.manual_seed(0)
    config = PaperModel(
        max_objects=4,
        width=16,
        latent_space=SphereConfig(anchors=9),
        decoder=TransformerConfig(heads=2, hidden=24, dropout=0.0),
        shape=ShapeDecoderConfig(width=8, level=1, template="box", fit_box=True),
    )
    return ScenePrior(config, classes=5).double()


def test_meshes_of_some_objects_are_those_of_all(torch_rng):
    prior = small_prior()
    z = prior.latent_space(torch.randn(3, 9, generator=torch_rng, dtype=torch.float64))
    shaped = torch.tensor([[True, True, True], [True, False, False], [False, False, False]])
    some, every = prior.decode(z, shaped.nonzero(as_tuple=True)), prior.decode(z)
    assert_close(some.centers_m, every.centers_m, rtol=0, atol=0)
    assert_close(some.vertices_m[:, :3][shaped], every.vertices_m[:, :3][shaped])
    middle = some.centers_m.unsqueeze(2).expand_as(some.vertices_m)
    assert_close(some.vertices_m[:, :3][~shaped], middle[:, :3][~shaped])
    assert_close(some.vertices_m[:, 3], middle[:, 3])
    weights = torch.randn(4, 42, 3, generator=torch_rng, dtype=torch.float64)
    learnt = [
        torch.autograd.grad(
            (scenes.vertices_m[:, :3][shaped] * weights).sum(), list(prior.shape.parameters())
        )
        for scenes in (some, every)
    ]
    assert_close(*learnt)
