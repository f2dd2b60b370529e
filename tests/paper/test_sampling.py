"""Latents of new rooms (seeds, covariances, neighbours), and by the names that users give them."""

import json

import numpy as np
import pytest
import torch
from refusals import refused
from torch.testing import assert_close

from sceneprior.apps.config import load_run
from sceneprior.core.scene import Scene
from sceneprior.paper.latents import LatentSphere
from sceneprior.paper.sampling import (
    DISTRIBUTIONS,
    draw_latents,
    read_latent,
    sample_latents,
    sample_logits,
    write_latents,
)

MANY = 20_000


@pytest.fixture
def sphere() -> LatentSphere:
    return LatentSphere(7, 12, seed=1)


@pytest.fixture
def trained(torch_rng) -> torch.Tensor:
    """Logits of 40 rooms, correlated."""
    mix = torch.randn(7, 7, generator=torch_rng)
    return torch.randn(40, 7, generator=torch_rng) @ mix + torch.randn(7, generator=torch_rng)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS)
def test_a_seed_gives_the_same_points_on_the_unit_sphere(sphere, trained, distribution):
    one = sample_latents(sphere, trained, 9, 3, distribution)
    assert one.shape == (9, 12)
    assert_close(one.norm(dim=-1), torch.ones(9), rtol=0, atol=1e-5)
    assert torch.equal(one, sample_latents(sphere, trained, 9, 3, distribution))
    assert not torch.equal(one, sample_latents(sphere, trained, 9, 4, distribution))


def test_the_papers_distribution_is_standard_normal_whatever_was_trained(trained):
    drawn = sample_logits(trained, MANY, 0, "paper")
    assert torch.equal(drawn, sample_logits(100 * trained, MANY, 0, "paper"))
    assert drawn.mean(dim=0).abs().max() < 0.04
    assert (drawn.T.cov() - torch.eye(7)).abs().max() < 0.05


def test_distributions_that_cannot_be_followed(sphere, trained):
    with refused("paper/no such distribution"):
        sample_latents(sphere, trained, 3, 0, "guess")
    with refused("paper/kernel of one room"):
        sample_latents(sphere, trained[:1], 3, 0, "kernel")


def test_kernel_keeps_mean_and_covariance():
    generator = torch.Generator().manual_seed(0)
    trained = torch.randn(50, 3, generator=generator, dtype=torch.float64) * torch.tensor([1, 2, 3])
    centred = trained - trained.mean(dim=1, keepdim=True)
    drawn = sample_logits(trained, 200_000, seed=0, distribution="kernel")
    torch.testing.assert_close(drawn.mean(0), centred.mean(0), rtol=0, atol=0.01)
    torch.testing.assert_close(torch.cov(drawn.T), torch.cov(centred.T), rtol=0.05, atol=0.02)


@pytest.fixture(scope="module")
def toy_prior(toy_run):
    return load_run(toy_run)


def test_rooms_and_seeds(toy_prior):
    room = toy_prior.room_ids[3]
    wanted = toy_prior.prior.latent_space(toy_prior.logits)[3]
    torch.testing.assert_close(read_latent(toy_prior, room), wanted)
    drawn, _ = draw_latents(toy_prior, 1, seed=7)
    assert torch.equal(read_latent(toy_prior, "seed:7"), drawn[0])
    assert not torch.equal(read_latent(toy_prior, "seed:8"), drawn[0])
    for distribution in ("paper", "kernel"):
        drawn, _ = draw_latents(toy_prior, 1, 7, distribution)
        assert torch.equal(read_latent(toy_prior, f"{distribution}:7"), drawn[0])


def rooms_of(z, names):
    pairs = zip(z.numpy(), names, strict=True)
    return [Scene(name, "front3d_bedroom", latent=latent) for latent, name in pairs]


def test_files(toy_prior, tmp_path):
    z, names = draw_latents(toy_prior, 4, seed=2)
    write_latents(tmp_path, rooms_of(z, names))
    npz = tmp_path / "latents.npz"
    # Close: a file's vector is normalised once more.
    torch.testing.assert_close(read_latent(toy_prior, str(npz)), z[0])
    torch.testing.assert_close(read_latent(toy_prior, f"{npz}:2"), z[2])
    torch.testing.assert_close(read_latent(toy_prior, f"{npz}:seed2_0003"), z[3])
    np.save(tmp_path / "one.npy", 5 * z[1].numpy())  # brought back onto the sphere
    torch.testing.assert_close(read_latent(toy_prior, str(tmp_path / "one.npy")), z[1])
    (tmp_path / "a.json").write_text(json.dumps(z.tolist()))
    torch.testing.assert_close(read_latent(toy_prior, f"{tmp_path}/a.json:1"), z[1])
    (tmp_path / "b.json").write_text(json.dumps({"latents": z.tolist(), "names": list("wxyz")}))
    torch.testing.assert_close(read_latent(toy_prior, f"{tmp_path}/b.json:y"), z[2])


def test_what_is_no_latent(toy_prior, tmp_path):
    write_latents(tmp_path, rooms_of(torch.eye(16)[:2], "ab"))
    arrays = {"long": np.ones(17), "zero": np.zeros(16), "nan": np.full(16, np.nan)}
    for name, array in (arrays | {"deep": np.zeros((2, 2, 16))}).items():
        np.save(tmp_path / f"{name}.npy", array)
    (tmp_path / "bad.json").write_text('{"vectors": []}')
    whole = (tmp_path / "latents.npz").read_bytes()
    (tmp_path / "short.npz").write_bytes(whole[:100])
    files = ("latents.npz:2", "latents.npz:c", "long.npy", "zero.npy", "nan.npy", "deep.npy",
             "bad.json", "short.npz")  # fmt: skip
    texts = {name: f"{tmp_path}/{name}" for name in files}
    texts |= {"room": "house/room", "seed": "seed:-1", "folder": str(tmp_path)}
    for name, text in texts.items():
        with refused(f"paper/latent {name.replace(':', ' ')}", tmp=tmp_path):
            read_latent(toy_prior, text)
