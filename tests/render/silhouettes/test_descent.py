"""Walks downhill: displaced ellipsoids and boxes return under their masks."""

import numpy as np
import pytest
import torch
from silhouette_scenes import MODES
from torch import Tensor
from toy_rooms import look_at

from sceneprior.core.geometry.meshes import icosphere, to_cube
from sceneprior.render.silhouettes.render import render_silhouettes

SIZE = (36, 48)
LENS = torch.tensor([[26.0, 0, 24], [0, 26, 18], [0, 0, 1]])
EYES = ([0, 1, 3.0], [2.5, 1.2, 1.0], [-2.4, 1.5, 0.5])
AROUND = np.array([0, 0.5, 0])
STEPS = (4.0,) * 30 + (0.5,) * 30 + (0.06,) * 40 + (0.01,) * 20
"""sigma in px2: first reaching far, then crisp, for the exact mode's soft masks are too large."""


class Room:
    """Copies of a room of ellipsoids (or boxes), each with its own centres and sizes."""

    def __init__(self, centers: Tensor, sizes: Tensor, mode: str, template: str = "sphere"):
        sphere, self.faces = icosphere(1)
        self.shape = to_cube(sphere) if template == "box" else sphere
        self.centers = centers.clone().requires_grad_()
        self.log_sizes = sizes.log().requires_grad_()
        self.mode = mode

    def masks(self, sigma_px2: float) -> Tensor:
        copies = len(self.centers)
        poses = torch.from_numpy(np.stack([look_at(np.array(eye), AROUND) for eye in EYES]))
        return render_silhouettes(
            self.shape * self.log_sizes.exp()[:, :, None] + self.centers[:, :, None],
            self.faces,
            poses.float().expand(copies, 3, 4, 4),
            LENS.expand(copies, 3, 3, 3),
            SIZE,
            sigma_px2=sigma_px2,
            mode=self.mode,
        )

    def hard(self) -> Tensor:
        with torch.no_grad():
            return self.masks(1e-3) > 0.5

    def overlap(self, observed: Tensor) -> Tensor:
        """IoU of the hard masks of every object of every copy, over all views."""
        hard = self.hard()
        both, either = ((op).sum(dim=(1, 3, 4)) for op in (hard & observed, hard | observed))
        return both / either

    def walk(self, observed: Tensor) -> None:
        optimizer = torch.optim.Adam([self.centers, self.log_sizes], lr=0.04)
        for sigma_px2 in STEPS:
            soft = self.masks(sigma_px2).clamp(1e-6, 1 - 1e-6)
            loss = torch.nn.functional.binary_cross_entropy(
                soft, observed.float().expand_as(soft), reduction="sum"
            )
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


@pytest.mark.parametrize("template", ["sphere", "box"])
@pytest.mark.parametrize("mode", MODES)
def test_a_displaced_object_walks_back_under_its_masks_from_everywhere(mode, template):
    center, size = torch.tensor([0.4, 0.5, -0.2]), torch.tensor([0.7, 0.5, 0.4])
    observed = Room(center[None, None], size[None, None], mode, template).hard()
    # Six directions, with a wrong size on the way; then twice, half and long instead of wide.
    offsets = torch.cat([torch.eye(3), -torch.eye(3), torch.zeros(3, 3)]) * 0.5
    scales = torch.tensor([[1.2] * 3] * 3 + [[0.8] * 3] * 3 + [[2.0] * 3, [0.5] * 3, [0.5, 1, 2.0]])
    room = Room((center + offsets)[:, None], (size * scales)[:, None], mode, template)
    assert room.overlap(observed).max() < 0.65
    room.walk(observed)
    assert room.overlap(observed).min() > 0.93  # 300 pixels; seen 0.946
    assert (room.centers - center).norm(dim=-1).max() < 0.05
    assert (room.log_sizes.exp() / size - 1).abs().max() < 0.08
