"""Walks on the sphere: even steps, objects that keep who they are, pictures from one view."""

import numpy as np
import torch
from PIL import Image
from torch.testing import assert_close

from sceneprior.paper.interpolate import (
    TILE,
    interpolate,
    mixed_colors,
    write_pictures,
)
from sceneprior.paper.sampling import decode_rooms
from sceneprior.render.topdown import corner_view, perspective


def test_steps_are_even_and_pictures_taken_from_one_view(trained, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneprior.paper.interpolate.STRIP_COLUMNS", 2)
    scenes = interpolate(trained, "toy/train_00", "seed:2", 3)
    assert [scene.name for scene in scenes] == ["step_00", "step_01", "step_02"]
    ends = {"from": "toy/train_00", "to": "seed:2", "along": 0.5}
    assert scenes[1].extra == {**ends, "slots": scenes[1].extra["slots"]}
    write_pictures(trained, scenes, tmp_path)
    z = torch.from_numpy(np.stack([scene.latent for scene in scenes]))
    assert_close((z[1:] * z[:-1]).sum(dim=1).diff(), torch.zeros(1), rtol=0, atol=1e-5)
    assert_close(z[0], trained.prior.latent_space(trained.logits[:1])[0])
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
