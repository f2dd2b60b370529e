"""`cpu` against `reference`: masks, front ids, depths and gradients, in both modes."""

import itertools

import numba
import numpy as np
import pytest
import torch
from silhouette_scenes import (
    COMPOSITING,
    MODES,
    cast,
    random_scene,
    render_and_grad,
    sphere_scene,
    triangles,
)
from torch.testing import assert_close

from sceneprior.core.cameras import project
from sceneprior.render.silhouettes.render import NEAR_FACE_M, render_scene, render_silhouettes


@pytest.fixture(params=itertools.product(MODES, COMPOSITING), ids="-".join)
def how(request) -> dict:
    return dict(zip(("mode", "compositing"), request.param, strict=True))


def backends_agree(scene: dict, **options) -> tuple:
    """The float64 result of `reference`, after `cpu` is compared with it in both precisions."""
    wanted = render_and_grad(scene, backend="reference", **options)
    in_float64 = render_and_grad(scene, backend="cpu", **options)
    in_float32 = render_and_grad(cast(scene, torch.float32), backend="cpu", **options)
    # float64: sums in another order; seen 6e-15 in masks and 2e-14 of the largest gradient.
    # float32: u and v are rounded, to 3e-5 px where a corner lies 400 px away, and sigma is as
    # small as 0.02 px2; seen 8e-6 in masks and 1e-4 of the largest gradient. No pixel of these
    # scenes lies so near an edge that rounding moves it to the other side.
    for drawn, masks_to, depth_to, grad_to in (
        (in_float64, 1e-12, 1e-12, 1e-9),
        (in_float32, 3e-5, 3e-5, 2e-4),
    ):
        masks, front, depth_m, grad = drawn
        assert masks.dtype == depth_m.dtype == grad.dtype and front.dtype == torch.int32
        assert_close(masks.double(), wanted[0], rtol=0, atol=masks_to)
        assert torch.equal(front, wanted[1])
        assert_close(depth_m.double(), wanted[2], rtol=depth_to, atol=0)
        largest = float(wanted[3].abs().max()) if wanted[3].numel() else 0.0
        assert_close(grad.double(), wanted[3], rtol=0, atol=grad_to * max(largest, 1e-30))
    return wanted


@pytest.mark.parametrize(("seed", "sigma_px2"), [(48, 0.02), (17, 0.3), (55, 6.0)])
def test_objects_before_beside_behind_and_around_the_camera(seed, sigma_px2, how):
    scene = random_scene(seed, views=2, faces=6)
    seen = project(scene["vertices_m"], scene["world_to_camera"], scene["intrinsics"])
    in_front = seen[..., 2] > NEAR_FACE_M
    assert (in_front.any(-1) & ~in_front.all(-1)).any()  # around the camera
    assert (~in_front.any(-1)).any()  # behind
    masks, front, depth_m, _ = backends_agree(scene, sigma_px2=sigma_px2, **how)
    assert (masks.amax(dim=(-1, -2)) > 0.9).any()
    assert (masks.amax(dim=(-1, -2)) == 0).any()
    assert torch.equal(front >= 0, depth_m < torch.inf)
    assert front.unique().tolist() == [-1, 0, 1, 2]


def test_blur_of_another_width_than_sigmas(how):
    for blur_px2 in (0.0, 14.4):
        backends_agree(sphere_scene(), sigma_px2=0.3, blur_px2=blur_px2, **how)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (17, 23), (8, 9)])
def test_odd_image_sizes_and_one_view(size, how):
    lens = torch.tensor([[9.0, 0, size[1] / 2], [0, 9, size[0] / 2], [0, 0, 1]]).double()
    scene = random_scene(3, rooms=1, views=1) | {"image_size": size, "intrinsics": lens[None, None]}
    masks, front, depth_m, _ = backends_agree(scene, sigma_px2=0.7, **how)
    assert masks.shape == (1, 1, 3, *size) and front.shape == depth_m.shape == (1, 1, *size)


@pytest.mark.parametrize("lacking", ["rooms", "objects", "views", "faces"])
def test_nothing_to_draw(lacking, how):
    scene = random_scene(3, rooms=1, views=2)
    if lacking == "rooms":
        for key in ("vertices_m", "world_to_camera", "intrinsics"):
            scene[key] = scene[key][:0]
    elif lacking == "objects":
        scene["vertices_m"] = scene["vertices_m"][:, :0]
    elif lacking == "views":
        scene["world_to_camera"] = scene["world_to_camera"][:, :0]
        scene["intrinsics"] = scene["intrinsics"][:, :0]
    else:
        scene["faces"] = scene["faces"][:0]
    masks, front, depth_m, grad = backends_agree(scene, **how)
    (rooms, objects), views = scene["vertices_m"].shape[:2], scene["world_to_camera"].shape[1]
    assert masks.shape == (rooms, views, objects, 24, 32) and front.shape == (rooms, views, 24, 32)
    assert (masks == 0).all() and (front == -1).all() and (depth_m == torch.inf).all()
    assert grad.shape == scene["vertices_m"].shape and (grad == 0).all()


def test_an_object_not_drawn_is_empty_hides_nothing_and_has_no_gradient(how):
    scene = sphere_scene()
    drawn = torch.tensor([[False, True]])
    masks, front, _, grad = backends_agree(scene, drawn=drawn, **how)
    alone = render_silhouettes(**scene, **how | {"compositing": "alone"})
    assert masks[0, 0, 0].max() == 0 and grad[0, 0].abs().max() == 0
    assert_close(masks[0, 0, 1], alone[0, 0, 1], rtol=0, atol=1e-12)
    assert set(front.unique().tolist()) == {-1, 1}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_the_number_of_threads_changes_no_bit(dtype, how, monkeypatch):
    scene = cast(random_scene(5), dtype)
    results = []
    for count in (1, 2, 2, 1):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", count)
        results.append(render_and_grad(scene, sigma_px2=1.0, **how))
    assert np.abs(results[0][3].numpy()).max() > 0.1
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            assert torch.equal(one, two)


def test_a_far_vertex_and_a_face_that_fills_the_image(how):
    # Corners at 1e5 px, and one object behind it.
    large = [[-9e3, -7e3, 1], [9e3, -7e3, 1], [0, 8e3, 1]]
    scene = triangles(large, [[0, 0, 2], [1, 0, 2], [0, 1, 2]])
    masks, front, depth_m = render_scene(**scene, backend="cpu", **how)
    assert (front == 0).all() and (depth_m == 1).all()
    assert_close(masks[0, 0, 0], torch.ones(24, 32, dtype=torch.float64), rtol=0, atol=1e-12)
