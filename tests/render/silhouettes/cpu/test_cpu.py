"""The CPU backend: compositing, moving cameras, memory, and threads."""

import os
import subprocess
import sys

import numpy as np
import pytest
import torch
from silhouette_scenes import (
    COMPOSITING,
    MODES,
    one_triangle_over_another,
    random_scene,
    triangles,
)
from torch.testing import assert_close

from sceneprior.render.silhouettes.render import render_scene, render_silhouettes

IMAGES, OBJECTS, HEIGHT, WIDTH = 2, 4, 3, 11


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_face_that_contains_the_pixel_centre_decides_the_depth_before_a_nearer_halo(
    mode, backend
):
    # Object 0 is one large wall at 3 m; object 1 a wall at 2 m whose right edge runs along
    # u = 16. One pixel to its right, 0 contains the centre and 1 only reaches it: 1 counts
    # as the nearer, for it is, but what a camera would see there is 0.
    wall = [[-20, -20, 3], [20, -20, 3], [0, 40, 3]]
    half = [[0, -20, 2], [-20, 0, 2], [0, 20, 2]]
    options = {"sigma_px2": 1.0, "mode": mode, "backend": backend}
    masks, front, depth_m = (x[0, 0] for x in render_scene(**triangles(wall, half), **options))
    assert front[12, 14:18].tolist() == [1, 1, 0, 0]
    assert_close(depth_m[12, 14:18], torch.tensor([2.0, 2, 3, 3]).double(), rtol=1e-9, atol=0)
    edge = [1 / (1 + np.exp(-s * d * d)) for s, d in ((1, 1.5), (1, 0.5), (-1, 0.5), (-1, 1.5))]
    assert_close(masks[1, 12, 14:18], torch.tensor(edge).double(), rtol=1e-6, atol=0)
    assert_close(masks[0, 12], 1 - masks[1, 12], rtol=0, atol=1e-12)

    # The same object: a far face that contains the centre, a near one whose halo reaches it.
    # A third between them in depth, which contains it too, is now in front of the whole object.
    both = triangles([*wall, *half], [*[[x, y, 2.5] for x, y, _ in wall], *[[0, 0, -1]] * 3])
    both["faces"] = torch.tensor([[0, 1, 2], [3, 4, 5]])
    masks, front, depth_m = (x[0, 0] for x in render_scene(**both, **options))
    assert front[12, 14:18].tolist() == [0, 0, 1, 1]
    assert_close(depth_m[12, 14:18], torch.tensor([2, 2, 2.5, 2.5]).double(), rtol=1e-9, atol=0)
    assert (masks[1, 12, 16:] > 1 - 1e-9).all() and (masks[0, 12, 16:] < 1e-9).all()


def gradients_of(way: str, **options) -> torch.Tensor:
    """Gradient of the front object's visible area with respect to the vertices."""
    scene = one_triangle_over_another()
    vertices = scene["vertices_m"].clone().requires_grad_()
    scene["vertices_m"] = vertices
    masks = render_silhouettes(**scene, compositing=way, sigma_px2=0.2, **options)
    masks[0, 0, 0].sum().backward()
    return vertices.grad[0]


@pytest.mark.parametrize("mode", MODES)
def test_only_layered_lets_a_boundary_between_two_objects_push_the_front_one(mode):
    gradients = {way: gradients_of(way, mode=mode) for way in COMPOSITING}
    assert gradients["alone"][0].abs().max() > 1
    # Nothing is nearer than the front object: seen as if alone, and the one behind has no say.
    assert_close(gradients["layered"][0], gradients["alone"][0], rtol=1e-12, atol=1e-12)
    assert gradients["layered"][1].abs().max() < 1e-12
    assert gradients["paper"].abs().max() < 1e-12


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_layered_masks_add_up_to_the_paper_s_whole_scene(mode, backend):
    options = {"sigma_px2": 0.8, "mode": mode, "backend": backend}
    scene = one_triangle_over_another()
    layered = render_silhouettes(**scene, compositing="layered", **options).sum(dim=2)
    paper = render_silhouettes(**scene, compositing="paper", **options)
    assert_close(layered, paper.sum(dim=2), rtol=0, atol=1e-12)
    assert ((paper > 0).sum(dim=2) <= 1).all()  # each pixel belongs to one object


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


def test_torch_keeps_its_number_of_threads():
    # In a process of its own: Numba starts its pool, which sets torch's threads, once in each.
    code = """
import numba, torch
from sceneprior.render.silhouettes.cpu.kernels import in_threads
torch.set_num_threads(1)
torch.get_num_threads()  # only now, or by a large sum, does torch ask OpenMP for them
in_threads(lambda first, last: None, 9)
print(torch.get_num_threads())
"""
    threads = {"NUMBA_NUM_THREADS": "2", "NUMBA_THREADING_LAYER": "omp"}
    say = [sys.executable, "-c", code]
    said = subprocess.run(say, capture_output=True, text=True, check=True, env=os.environ | threads)
    assert said.stdout == "1\n"
