"""What people may call a latent: a training room, a seed, a file."""

import json

import numpy as np
import pytest
import torch

from sceneprior.config import load_run
from sceneprior.errors import InputError
from sceneprior.generation.decode import draw_latents
from sceneprior.generation.latents import read_latent, write_latents


@pytest.fixture(scope="module")
def trained(toy_run):
    return load_run(toy_run)


def test_rooms_and_seeds(trained):
    room = trained.room_ids[3]
    wanted = trained.prior.latent_space(trained.logits)[3]
    torch.testing.assert_close(read_latent(trained, room), wanted)
    drawn, _ = draw_latents(trained, 1, seed=7)
    assert torch.equal(read_latent(trained, "seed:7"), drawn[0])
    assert not torch.equal(read_latent(trained, "seed:8"), drawn[0])


def test_files(trained, tmp_path):
    z, names = draw_latents(trained, 4, seed=2)
    write_latents(tmp_path, z, names)
    npz = tmp_path / "latents.npz"
    # Close: a file's vector is normalised once more.
    torch.testing.assert_close(read_latent(trained, str(npz)), z[0])
    torch.testing.assert_close(read_latent(trained, f"{npz}:2"), z[2])
    torch.testing.assert_close(read_latent(trained, f"{npz}:seed2_0003"), z[3])
    np.save(tmp_path / "one.npy", 5 * z[1].numpy())  # brought back onto the sphere
    torch.testing.assert_close(read_latent(trained, str(tmp_path / "one.npy")), z[1])
    (tmp_path / "a.json").write_text(json.dumps(z.tolist()))
    torch.testing.assert_close(read_latent(trained, f"{tmp_path}/a.json:1"), z[1])
    (tmp_path / "b.json").write_text(json.dumps({"latents": z.tolist(), "names": list("wxyz")}))
    torch.testing.assert_close(read_latent(trained, f"{tmp_path}/b.json:y"), z[2])


def test_what_is_no_latent_is_a_sentence(trained, tmp_path):
    def said(text: object) -> str:
        with pytest.raises(InputError) as error:
            read_latent(trained, str(text))
        return str(error.value)

    assert said("house/room") == (
        "'house/room' is neither a training room of this run (such as toy/train_00), nor "
        "seed:NUMBER, nor a file of latents (.npz, .npy, .json)."
    )
    assert "neither a training room" in said("seed:-1") and "neither" in said(tmp_path)
    write_latents(tmp_path, torch.eye(16)[:2], ["a", "b"])
    npz = tmp_path / "latents.npz"
    assert f"{npz} has no latent '2': it holds 2 and names such as a." == said(f"{npz}:2")
    assert "has no latent 'c'" in said(f"{npz}:c")
    np.save(tmp_path / "long.npy", np.ones(17))
    assert "holds latents of 17 numbers, but this run's have 16" in said(tmp_path / "long.npy")
    np.save(tmp_path / "zero.npy", np.zeros(16))
    assert "all zeros or holds no numbers" in said(tmp_path / "zero.npy")
    np.save(tmp_path / "nan.npy", np.full(16, np.nan))
    assert "all zeros or holds no numbers" in said(tmp_path / "nan.npy")
    np.save(tmp_path / "deep.npy", np.zeros((2, 2, 16)))
    assert "holds no latents (ValueError: an array of shape (2, 2, 16))" in said(
        tmp_path / "deep.npy"
    )
    (tmp_path / "bad.json").write_text('{"vectors": []}')
    assert "holds no latents (KeyError" in said(tmp_path / "bad.json")
    npz.write_bytes(npz.read_bytes()[:100])
    assert "holds no latents (" in said(npz)
