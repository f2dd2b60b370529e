"""Walks on the sphere: even steps, objects that keep who they are, pictures from one view."""

import numpy as np
import pytest
import torch
from PIL import Image

from sceneprior.paper.interpolate import (
    TILE,
    interpolate,
    mixed_colors,
    write_pictures,
)
from sceneprior.paper.sampling import decode_latents, decode_rooms
from sceneprior.render.topdown import corner_view, perspective


def test_steps_are_even_and_end_where_they_should(trained):
    scenes = interpolate(trained, "toy/train_00", "seed:4", 7)
    z = torch.from_numpy(np.stack([scene.latent for scene in scenes]))
    angles = torch.acos((z[1:] * z[:-1]).sum(dim=1).clamp(-1, 1))
    torch.testing.assert_close(angles, angles.mean().expand(6), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(z.norm(dim=1), torch.ones(7))
    assert [scene.name for scene in scenes] == [f"step_{k:02d}" for k in range(7)]
    assert [scene.extra["along"] for scene in scenes] == pytest.approx(
        np.linspace(0, 1, 7), abs=1e-6
    )
    assert (scenes[0].extra["from"], scenes[0].extra["to"]) == ("toy/train_00", "seed:4")
    first = decode_latents(trained, trained.prior.latent_space(trained.logits[:1]), ["step_00"])[0]
    assert len(first.objects) == len(scenes[0].objects) > 0
    np.testing.assert_allclose(first.centers_m, scenes[0].centers_m, atol=1e-5)


def test_pictures_are_taken_from_one_view(trained, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneprior.paper.interpolate.STRIP_COLUMNS", 2)
    scenes = interpolate(trained, "seed:1", "seed:2", 3)
    write_pictures(trained, scenes, tmp_path)
    z = torch.from_numpy(np.stack([scene.latent for scene in scenes]))
    height, width = TILE
    sheet = np.asarray(Image.open(tmp_path / "strip.png"))
    assert sheet.shape == (2 * height, 2 * width, 3)  # more than a row
    rooms = decode_rooms(trained, z, ["a"] * 3)
    view = corner_view([room.scene for room in rooms], TILE)
    last = perspective(rooms[-1].scene, view=view, colors=mixed_colors(rooms[-1]))
    apart = np.abs(sheet[height:, :width].astype(int) - last)
    assert np.quantile(apart, 0.99) <= 2
    assert (sheet[height:, width:] == 255).all()
    gif = Image.open(tmp_path / "animation.gif")
    assert gif.size == (width, height) and gif.info["loop"] == 0
    assert 2 < gif.n_frames <= 2 * 8  # there and back
