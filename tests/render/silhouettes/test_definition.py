"""The exact formula: the reference against one pixel at a time, its edges, its gradients."""

import math

import numpy as np
import pytest
import torch
from references.silhouettes import composite_loop, exact_loop
from silhouette_scenes import COMPOSITING, MODES, SIZE, random_scene, triangles
from toy_rooms import look_at

from sceneprior.core.cameras import project
from sceneprior.render.silhouettes import reference
from sceneprior.render.silhouettes.render import NEAR_FACE_M, render_silhouettes

BACKENDS = ("cpu", "reference")


@pytest.mark.parametrize("sigma_px2", [0.02, 1.5])
def test_the_reference_is_the_definition_one_pixel_at_a_time(sigma_px2):
    scene = random_scene(7, rooms=1, objects=3, views=2, faces=6, spread=1.0)
    seen = project(scene["vertices_m"], scene["world_to_camera"], scene["intrinsics"])[0]
    drawn = torch.tensor([[True, True, True], [True, False, True]])
    blur_px2 = math.log(1 / 1e-4 - 1) * sigma_px2
    settings = reference.Settings(SIZE, sigma_px2, blur_px2, NEAR_FACE_M, "exact", "alone")
    by_hand = exact_loop(
        *(x.flatten(0, 1).numpy() for x in (seen[..., :2], seen[..., 2])),
        scene["faces"].numpy(),
        drawn.flatten(),
        settings,
    )
    coverage, order, depth = by_hand.reshape(3, 2, 3, *SIZE)
    assert 0.02 < coverage.mean() < 0.7 and not coverage[1, 1].any()
    halo = np.isfinite(order) & ~np.isfinite(depth)
    assert halo.sum() > 50 and np.isfinite(depth).sum() > 50
    for compositing in COMPOSITING:
        masks, front, depth_m = reference.draw(
            seen[..., :2],
            seen[..., 2],
            scene["faces"],
            drawn,
            settings._replace(compositing=compositing),
        )
        expected = composite_loop(coverage, order, compositing)
        # The same float64 sums in another order.
        np.testing.assert_allclose(masks.numpy(), expected, rtol=0, atol=1e-12)
        nearest = depth.min(axis=1)
        np.testing.assert_allclose(depth_m.numpy(), nearest, rtol=1e-12)
        ids = np.where(np.isfinite(nearest), depth.argmin(axis=1), -1)
        np.testing.assert_array_equal(front.numpy(), ids)


@pytest.mark.parametrize("backend", BACKENDS)
def test_half_covered_on_the_edge_and_27_percent_at_root_sigma(backend):
    # The left edge of a large triangle runs along u = 16; z = 1 and fx = 16.
    shift = 0.5 / 16  # ... moved onto the pixel centres of column 16.
    scene = triangles([[shift, -90, 1], [90, 0, 1], [shift, 90, 1]])
    expected = [1 / (1 + math.exp(-((c - 16) * abs(c - 16)) / 4)) for c in range(11, 22)]
    for mode in MODES:
        masks = render_silhouettes(**scene, sigma_px2=4.0, mode=mode, backend=backend)
        middle = masks[0, 0, 0, 12]
        np.testing.assert_allclose(middle[11:22].numpy(), expected, rtol=1e-12)
        assert middle[9] == 0  # 7 px out; the blur radius is 6.07 px
        assert math.isclose(middle[14], 1 / (1 + math.e), rel_tol=1e-12)


@pytest.mark.parametrize("mode", MODES)
def test_a_face_at_the_near_plane_is_drawn_just_beyond_it(mode):
    for z, drawn in (
        (NEAR_FACE_M * 1.001, True),
        (NEAR_FACE_M, False),
        (NEAR_FACE_M * 0.999, False),
    ):
        corners = torch.tensor([[-1.0, -1, 1], [1, -1, 1], [0, 1, 1]], dtype=torch.float64) * z
        for backend in BACKENDS:
            masks = render_silhouettes(**triangles(corners.tolist()), mode=mode, backend=backend)
            assert bool(masks.max() > 0.99) is drawn and bool((masks == 0).all()) is not drawn


def pyramids(size=(6, 7)) -> dict:
    """Two closed little pyramids that overlap on screen, in two views."""
    scene = random_scene(2, rooms=1, objects=2, views=2, corners=4, faces=4, spread=0.3)
    eyes = (np.array([0.2, 0.4, 3.0]), np.array([-2.6, 0.8, 0.3]))
    poses = np.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    lens = torch.tensor([[4.6, 0, size[1] / 2], [0, 4.6, size[0] / 2], [0, 0, 1]]).double()
    return scene | {
        "faces": torch.tensor([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]),
        "world_to_camera": torch.from_numpy(poses)[None],
        "intrinsics": lens.expand(1, 2, 3, 3),
        "image_size": size,
    }


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("compositing", COMPOSITING)
@pytest.mark.parametrize("mode", MODES)
def test_gradients_pass_gradcheck(mode, compositing, backend):
    scene = pyramids()
    vertices = scene.pop("vertices_m")
    options = scene | {"sigma_px2": 0.6, "mode": mode, "backend": backend}
    alone = render_silhouettes(vertices, **options, compositing="alone")
    assert (alone.flatten(3).sum(-1) > 1).all()  # both objects are seen in both views
    # No pixel changes its nearest edge, its side or its reach within 1e-6 m of these corners.
    assert torch.autograd.gradcheck(
        lambda vertices: render_silhouettes(vertices, **options, compositing=compositing),
        (vertices.requires_grad_(),),
        eps=1e-6,
        atol=1e-6,
        rtol=1e-5,
    )
