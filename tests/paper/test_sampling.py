"""Latents of new rooms, by seed or by the names that users give them, and their scenes."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from tiny_runs import tiny_config
from torch.testing import assert_close

from sceneprior.apps.api import load
from sceneprior.core.scene import Scene
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import (
    DISTRIBUTIONS,
    draw_latents,
    read_latent,
    sample_logits,
    to_rooms,
    write_latents,
)


@pytest.fixture(scope="module")
def toy_prior(toy_run):
    return load(toy_run).with_latents


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_a_seed_gives_the_same_points_on_the_unit_sphere(toy_prior, distribution):
    one = draw_latents(toy_prior, 9, 3, distribution)
    assert_close(one.norm(dim=-1), torch.ones(9), rtol=0, atol=1e-5)
    assert torch.equal(one, draw_latents(toy_prior, 9, 3, distribution))
    assert not torch.equal(one, draw_latents(toy_prior, 9, 4, distribution))


def test_the_papers_distribution_is_standard_normal_whatever_was_trained(torch_rng):
    trained = torch.randn(40, 7, generator=torch_rng)
    drawn = sample_logits(trained, 20_000, 0, "paper", True)
    assert torch.equal(drawn, sample_logits(100 * trained, 20_000, 0, "paper", True))
    assert drawn.mean(dim=0).abs().max() < 0.04
    assert (drawn.T.cov() - torch.eye(7)).abs().max() < 0.05


def test_distributions_that_cannot_be_followed(toy_prior):
    with refused("paper/no such distribution"):
        draw_latents(toy_prior, 3, 0, "guess")
    with refused("paper/kernel of one room"):
        draw_latents(replace(toy_prior, logits=toy_prior.logits[:1]), 3, 0, "kernel")


def test_kernel_keeps_mean_and_covariance():
    generator = torch.Generator().manual_seed(0)
    trained = torch.randn(50, 3, generator=generator, dtype=torch.float64) * torch.tensor([1, 2, 3])
    centred = trained - trained.mean(dim=1, keepdim=True)
    drawn = sample_logits(trained, 200_000, 0, "kernel", True)
    assert_close(drawn.mean(0), centred.mean(0), rtol=0, atol=0.01)
    assert_close(torch.cov(drawn.T), torch.cov(centred.T), rtol=0.05, atol=0.02)


def test_rooms_and_seeds(toy_prior):
    wanted = toy_prior.prior.latent_space(toy_prior.logits)[3]
    assert_close(read_latent(toy_prior, toy_prior.room_ids[3]), wanted)
    for name, distribution in (("seed", None), ("paper", "paper"), ("kernel", "kernel")):
        drawn = draw_latents(toy_prior, 1, 7, distribution)[0]
        assert torch.equal(read_latent(toy_prior, f"{name}:7"), drawn)
        assert not torch.equal(read_latent(toy_prior, f"{name}:8"), drawn)


def rooms_of(z, names):
    pairs = zip(z.numpy(), names, strict=True)
    return [Scene(name, "front3d_bedroom", latent=latent) for latent, name in pairs]


def test_files(toy_prior, tmp_path):
    z = draw_latents(toy_prior, 4, seed=2)
    write_latents(tmp_path, rooms_of(z, [f"seed2_{k:04d}" for k in range(4)]))
    npz = tmp_path / "latents.npz"
    # Close: a file's vector is normalised once more.
    for end, row in (("", 0), (":2", 2), (":seed2_0003", 3)):
        assert_close(read_latent(toy_prior, f"{npz}{end}"), z[row])
    np.savez(npz, latents=5 * z.numpy())  # brought back onto the sphere
    assert_close(read_latent(toy_prior, f"{npz}:1"), z[1])


def test_what_is_no_latent(toy_prior, tmp_path):
    write_latents(tmp_path, rooms_of(torch.eye(16)[:2], "ab"))
    arrays = {"long": np.ones((1, 17)), "zero": np.zeros((1, 16)), "nan": np.full((1, 16), np.nan)}
    for name, array in (arrays | {"deep": np.zeros((2, 2, 16))}).items():
        np.savez(tmp_path / f"{name}.npz", latents=array)
    np.savez(tmp_path / "bad.npz", vectors=[])
    whole = (tmp_path / "latents.npz").read_bytes()
    (tmp_path / "short.npz").write_bytes(whole[:100])
    files = ("latents.npz:2", "latents.npz:c", "long.npz", "zero.npz", "nan.npz", "deep.npz",
             "bad.npz", "short.npz")  # fmt: skip
    texts = {name: f"{tmp_path}/{name}" for name in files}
    texts |= {"room": "house/room", "seed": "seed:-1", "folder": str(tmp_path)}
    for name, text in texts.items():
        with refused(f"paper/latent {name.replace(':', ' ')}", tmp=tmp_path):
            read_latent(toy_prior, text)


@pytest.fixture
def decoded(torch_rng) -> DecodedScenes:
    """Two rooms of four objects of classes 9, 13, 0 (void), 21."""
    logits = torch.zeros(2, 4, 22)
    for item, label in enumerate((9, 13, 0, 21)):
        logits[:, item, label] = 3
    return DecodedScenes(
        class_logits=logits,
        centers_m=torch.rand(2, 4, 3, generator=torch_rng),
        sizes_m=torch.rand(2, 4, 3, generator=torch_rng) + 0.1,
        completeness_logits=torch.tensor([[2.0, 0.1, 5.0, 0.3], [1.0, -0.01, 5.0, 5.0]]),
        vertices_m=torch.rand(2, 4, 6, 3, generator=torch_rng),
    )


@pytest.fixture
def trained(tmp_path):
    """A prior whose meshes have two triangles."""
    config = tiny_config(tmp_path)
    prior = config.build_prior()
    prior.shape.faces = torch.tensor([[0, 1, 2], [3, 4, 5]])
    return TrainedPrior(prior, (), config, "shape", torch.zeros(0, 4))


def labels(scene) -> list[str]:
    return [item.label for item in scene.objects]


def test_a_scene_ends_at_the_first_object_whose_completeness_falls(decoded, trained):
    rooms = to_rooms(trained, decoded, ["a", "b"])
    assert [room.predictions for room in rooms] == [[0, 1, 3], [0]]
    assert torch.equal(rooms[0].class_logits, decoded.class_logits[0, [0, 1, 3]])
    first, second = (room.scene for room in rooms)
    assert (first.name, second.name) == ("a", "b")
    # void is decoded like any class, but is no furniture; what follows it stays.
    assert labels(first) == ["double_bed", "nightstand", "wardrobe"]
    # The second ends before its second object, though later ones score high again.
    assert labels(second) == ["double_bed"]
    for item, source in zip(first.objects, (0, 1, 3), strict=True):
        np.testing.assert_array_equal(item.center_m, decoded.centers_m[0, source])
        np.testing.assert_array_equal(item.size_m, decoded.sizes_m[0, source])
        np.testing.assert_array_equal(item.mesh.vertices_m, decoded.vertices_m[0, source])
        np.testing.assert_array_equal(item.mesh.faces, trained.prior.shape.faces)
