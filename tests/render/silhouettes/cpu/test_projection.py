"""The compiled projection against `geometry.cameras.project`, and cameras that move."""

import pytest
import torch
from silhouette_scenes import MODES, cast, random_scene
from torch.testing import assert_close

from sceneprior.core.geometry.cameras import MIN_DEPTH_M, project
from sceneprior.render.silhouettes.cpu.projection import project_in_threads
from sceneprior.render.silhouettes.render import render_silhouettes


@pytest.mark.parametrize(("dtype", "to"), [(torch.float64, 1e-12), (torch.float32, 2e-5)])
def test_pixels_depths_and_gradients_are_the_plain_projections(dtype, to):
    scene = cast(random_scene(48, rooms=2, objects=3, views=3), dtype)
    cameras = (scene["world_to_camera"], scene["intrinsics"])
    mine, plain = (scene["vertices_m"].clone().requires_grad_() for _ in range(2))
    pixels, depths = project_in_threads(mine, *cameras)
    wanted = project(plain, *cameras).flatten(0, 1)
    assert (depths < MIN_DEPTH_M).any() and (depths > MIN_DEPTH_M).any()
    assert not depths.requires_grad
    scale = wanted.detach().abs().max()
    assert_close(pixels, wanted[..., :2], rtol=to, atol=to * float(scale))
    assert_close(depths, wanted[..., 2], rtol=to, atol=to)
    upstream = torch.randn(pixels.shape, generator=torch.Generator().manual_seed(0)).to(dtype)
    (pixels * upstream).sum().backward()
    (wanted[..., :2] * upstream).sum().backward()
    assert_close(mine.grad, plain.grad, rtol=to, atol=to * float(plain.grad.abs().max()))


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
