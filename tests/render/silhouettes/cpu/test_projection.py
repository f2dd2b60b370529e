"""The compiled projection against `geometry.cameras.project`, and cameras that move."""

import pytest
from silhouette_scenes import MODES, random_scene
from torch.testing import assert_close

from sceneprior.render.silhouettes.render import render_silhouettes


@pytest.mark.parametrize("mode", MODES)
def test_a_camera_that_moves_has_a_gradient_in_both_backends(mode):
    scene = random_scene(17, views=2)
    gradients = {}
    for backend in ("cpu", "reference"):
        moving = {k: scene[k].clone().requires_grad_() for k in ("world_to_camera", "intrinsics")}
        masks = render_silhouettes(**scene | moving, mode=mode, sigma_px2=0.5, backend=backend)
        (masks * masks).sum().backward()
        gradients[backend] = [camera.grad for camera in moving.values()]
    for mine, wanted in zip(gradients["cpu"], gradients["reference"], strict=True):
        assert wanted.abs().max() > 0.1
        assert_close(mine, wanted, rtol=0, atol=1e-9 * float(wanted.abs().max()))
