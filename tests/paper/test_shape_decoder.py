"""Deformed templates: where they start, what fills the box, and the split first layer."""

import pytest
import torch
from torch.testing import assert_close

from sceneprior.core.proxies import icosphere, to_cube
from sceneprior.paper.config import PaperModel
from sceneprior.paper.latents import SphereConfig
from sceneprior.paper.prior import ScenePrior
from sceneprior.paper.shape_decoder import ShapeDecoder, ShapeDecoderConfig, fill_unit_box
from sceneprior.paper.transformer import TransformerConfig


@pytest.mark.parametrize("template", ["sphere", "box"])
def test_deformation_starts_from_the_plain_template(torch_rng, template):
    torch.manual_seed(0)
    model = ShapeDecoder(32, ShapeDecoderConfig(width=16, level=1, template=template))
    meshes = model(torch.randn(3, 4, 32, generator=torch_rng))
    sphere, faces = icosphere(1)
    wanted = sphere if template == "sphere" else to_cube(sphere)
    assert torch.equal(model.faces, faces)
    assert meshes.shape == (3, 4, 42, 3)
    # 1% of the box's half: the last layer's weights are scaled by 0.01.
    assert_close(meshes, wanted.expand(3, 4, -1, -1), rtol=0, atol=0.01)
    assert not torch.equal(meshes[0, 0], meshes[0, 1])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_fit_box_fills_the_unit_box_exactly(torch_rng, dtype):
    vertices = torch.randn(5, 4, 30, 3, generator=torch_rng, dtype=dtype) * torch.tensor(
        [3, 1, 0.1]
    )
    fitted = fill_unit_box(vertices.to(dtype) + 2)
    one = torch.ones(5, 4, 3, dtype=dtype)
    atol = 4 * torch.finfo(dtype).eps * 10  # a few roundings of numbers up to 10
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
    some, every = prior.decode(z, shaped), prior.decode(z)
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
