"""The soft renderer: a loop per pixel, plain torch and Numba say the same; so do gradients."""

import math
import subprocess
import sys

import numba
import numpy as np
import pytest
import torch
from references.silhouettes import composite_loop, soft_coverage_loop
from torch.testing import assert_close
from toy_rooms import look_at

from sceneprior.geometry.cameras import project
from sceneprior.geometry.meshes import icosphere, to_cube
from sceneprior.silhouettes import compositing, cpu, reference
from sceneprior.silhouettes.render import NEAR_M, render_silhouettes, sigma_from_ndc

MODES = ("layered", "paper", "alone")
LENS = torch.tensor([[16.0, 0, 16], [0, 16, 12], [0, 0, 1]], dtype=torch.float64)
SIZE = (24, 32)
FRONT = torch.eye(4, dtype=torch.float64)[None, None]


def random_scene(seed: int, rooms=2, objects=3, views=4, corners=9, faces=8, spread=3.0) -> dict:
    """Triangle soups around the origin, cameras among them: objects lie before, beside, behind."""
    rng = np.random.default_rng(seed)
    centers = rng.uniform(-spread, spread, (rooms, objects, 1, 3))
    vertices = centers + rng.normal(0, 0.6, (rooms, objects, corners, 3))
    poses = [
        [look_at(rng.uniform(-2, 2, 3), rng.uniform(-1, 1, 3)) for _ in range(views)]
        for _ in range(rooms)
    ]
    return {
        "vertices_m": torch.from_numpy(vertices),
        "faces": torch.from_numpy(rng.integers(0, corners, (faces, 3))),
        "world_to_camera": torch.from_numpy(np.array(poses)),
        "intrinsics": LENS.expand(rooms, views, 3, 3),
        "image_size": SIZE,
    }


def sphere_scene() -> dict:
    """Two spheres before one camera, the first half over the second."""
    sphere, faces = icosphere(1)
    centers = torch.tensor([[0.3, 0, 2.5], [-0.3, 0, 3.5]], dtype=torch.float64)
    return {
        "vertices_m": (sphere.double() * 0.6 + centers[:, None])[None],
        "faces": faces,
        "world_to_camera": FRONT,
        "intrinsics": LENS[None, None],
        "image_size": SIZE,
    }


def triangles(*corners, size=SIZE, lens=LENS) -> dict:
    """One object a triangle, in camera space."""
    return {
        "vertices_m": torch.tensor([corners], dtype=torch.float64),
        "faces": torch.tensor([[0, 1, 2]]),
        "world_to_camera": FRONT,
        "intrinsics": lens[None, None],
        "image_size": size,
    }


def masks_and_gradient(scene: dict, **options) -> tuple[torch.Tensor, torch.Tensor]:
    vertices = scene["vertices_m"].clone().requires_grad_()
    masks = render_silhouettes(**{**scene, "vertices_m": vertices}, **options)
    generator = torch.Generator().manual_seed(1)
    upstream = torch.randn(masks.shape, generator=generator, dtype=masks.dtype)
    (masks * upstream).sum().backward()
    return masks.detach(), vertices.grad


def backends_agree(scene: dict, **options) -> torch.Tensor:
    masks, gradient = masks_and_gradient(scene, backend="cpu", **options)
    wanted, wanted_gradient = masks_and_gradient(scene, backend="reference", **options)
    # Numba stops counting faces of a pixel that is covered but for exp(-18) = 1.5e-8.
    assert_close(masks, wanted, rtol=0, atol=math.exp(-cpu.CERTAIN))
    scale = float(wanted_gradient.abs().max())
    assert_close(gradient, wanted_gradient, rtol=1e-6, atol=1e-6 * max(scale, 1e-30))
    return wanted


@pytest.mark.parametrize("sigma_px2", [0.02, 1.5])
def test_the_reference_is_the_definition_one_pixel_at_a_time(sigma_px2):
    scene = random_scene(7, rooms=1, objects=3, views=2, faces=6, spread=1.0)
    seen = project(scene["vertices_m"], scene["world_to_camera"], scene["intrinsics"]).flatten(0, 2)
    drawn = torch.tensor([True, True, True, True, False, True])
    settings = (SIZE, sigma_px2, math.log(1 / 1e-4 - 1) * sigma_px2, NEAR_M)
    arguments = (seen[..., :2], seen[..., 2], scene["faces"], drawn)
    coverage, depth = reference.soft_coverage(*arguments, *settings)
    by_hand, depth_by_hand = soft_coverage_loop(*(x.numpy() for x in arguments), *settings)
    assert 0.02 < by_hand.mean() < 0.7 and not by_hand[4].any()
    # The same float64 sums in another order.
    np.testing.assert_allclose(coverage.numpy(), by_hand, rtol=0, atol=1e-12)
    np.testing.assert_allclose(depth.numpy(), depth_by_hand, rtol=1e-12)
    for mode in compositing.MODES:
        layers = (coverage.reshape(2, 3, *SIZE), depth.reshape(2, 3, *SIZE))
        expected = composite_loop(*(x.numpy() for x in layers), mode)
        for engine in (reference, compositing):
            visible = engine.composite(*layers, mode)
            np.testing.assert_allclose(visible.numpy(), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(4))
def test_numba_equals_the_reference_before_beside_behind_and_around_the_camera(seed, mode):
    scene = random_scene(seed)
    seen = project(scene["vertices_m"], scene["world_to_camera"], scene["intrinsics"])
    in_front = seen[..., 2] > NEAR_M
    assert (in_front.any(-1) & ~in_front.all(-1)).any()  # around the camera
    assert (~in_front.any(-1)).any()  # behind
    masks = backends_agree(scene, compositing=mode, sigma_px2=(0.02, 0.3, 1.5, 6.0)[seed])
    assert (masks.amax(dim=(-1, -2)) > 0.9).any()


@pytest.mark.parametrize("mode", MODES)
def test_meshes_whose_faces_share_edges(mode):
    masks = backends_agree(sphere_scene(), compositing=mode)
    assert 40 < masks[0, 0, 0].sum() < 60  # pi * (16 * 0.6 / 2.5)**2 = 46, and a soft rim


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (5, 1), (17, 23)])
def test_odd_image_sizes(size):
    lens = torch.tensor([[9.0, 0, size[1] / 2], [0, 9, size[0] / 2], [0, 0, 1]]).double()
    scene = random_scene(3, rooms=1, views=1) | {"image_size": size, "intrinsics": lens[None, None]}
    assert backends_agree(scene, sigma_px2=0.7).shape == (1, 1, 3, *size)


def test_triangles_smaller_than_a_pixel():
    generator = torch.Generator().manual_seed(0)
    places = torch.rand(12, 1, 3, generator=generator, dtype=torch.float64) * 2 - 1
    places[..., 2] += 3
    shapes = torch.randn(12, 3, 3, generator=generator, dtype=torch.float64) * 0.02
    scene = triangles(*((places + shapes).tolist()))
    masks = backends_agree(scene, compositing="alone", sigma_px2=0.05)
    assert masks.amax() < 0.99 and (masks.flatten(3).amax(-1) > 1e-3).sum() >= 10


def test_faces_without_an_area_are_not_drawn():
    scene = triangles(
        [[0, 0, 2], [1, 0.1, 2], [0.3, 1, 2]], [[-1, 0.2, 2], [0, 0.2, 2], [1, 0.2, 2]]
    )
    scene["faces"] = torch.tensor([[0, 1, 2], [0, 0, 1], [2, 2, 2]])
    masks = backends_agree(scene, compositing="alone", sigma_px2=0.5)
    assert masks[0, 0, 0].max() > 0.9 and masks[0, 0, 1].max() == 0


def test_an_object_not_drawn_is_empty_hides_nothing_and_has_no_gradient():
    scene = sphere_scene()
    drawn = torch.tensor([[False, True]])
    for mode in MODES:
        masks = backends_agree(scene, compositing=mode, drawn=drawn)
        _, gradient = masks_and_gradient(scene, compositing=mode, drawn=drawn)
        alone = render_silhouettes(**scene, compositing="alone")
        assert masks[0, 0, 0].max() == 0 and gradient[0, 0].abs().max() == 0
        assert_close(masks[0, 0, 1], alone[0, 0, 1], rtol=0, atol=2e-8)


def test_an_empty_view_is_zero_and_harmless():
    scene = sphere_scene()
    scene["vertices_m"] = scene["vertices_m"] * torch.tensor([1, 1, -1])
    for mode in MODES:
        masks, gradient = masks_and_gradient(scene, compositing=mode)
        assert masks.abs().max() == 0 and gradient.abs().max() == 0
        backends_agree(scene, compositing=mode)


def test_faces_that_reach_behind_the_near_plane_are_left_out_alone():
    scene = random_scene(11, rooms=1, objects=1, views=1, corners=30, faces=10, spread=0)
    scene["world_to_camera"] = FRONT
    scene["faces"] = torch.arange(30).reshape(10, 3)
    kept = (scene["vertices_m"][0, 0, :, 2].reshape(10, 3) > NEAR_M).all(dim=1)
    assert 0 < kept.sum() < 10
    whole = render_silhouettes(**scene, sigma_px2=0.5)
    part = render_silhouettes(**scene | {"faces": scene["faces"][kept]}, sigma_px2=0.5)
    assert whole.max() > 0.5
    assert torch.equal(whole, part)


def test_half_covered_on_the_edge_and_27_percent_at_root_sigma():
    # The left edge of a large triangle runs along u = 16; z = 1 and fx = 16.
    shift = 0.5 / 16  # ... moved onto the pixel centres of column 16.
    scene = triangles([[shift, -90, 1], [90, 0, 1], [shift, 90, 1]])
    masks = render_silhouettes(**scene, sigma_px2=4.0)[0, 0, 0]
    middle = masks[12]
    expected = [1 / (1 + math.exp(-((c - 16) * abs(c - 16)) / 4)) for c in range(11, 22)]
    expected[0] = 1 / (1 + math.exp(25 / 4))  # 5 px: within the blur radius of 6.07 px
    np.testing.assert_allclose(middle[11:22].numpy(), expected, rtol=1e-12)
    assert middle[9] == 0  # 7 px out
    assert math.isclose(middle[14], 1 / (1 + math.e))


def test_default_sigma_is_the_papers_in_squared_ndc():
    assert sigma_from_ndc(1e-4, (90, 120)) == pytest.approx(0.2025)  # from oracle_silhouettes.md
    scene = sphere_scene()
    given = render_silhouettes(**scene, sigma_px2=1e-4 * 12**2)
    assert torch.equal(render_silhouettes(**scene), given)


@pytest.mark.parametrize("backend", ["cpu", "reference"])
@pytest.mark.parametrize("mode", MODES)
def test_gradients_pass_gradcheck(mode, backend):
    # Closed little pyramids that overlap on screen, in a picture of 8 x 9 pixels.
    scene = random_scene(2, rooms=1, objects=2, views=2, corners=4, faces=4, spread=0.3)
    scene["faces"] = torch.tensor([[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]])
    eyes = (np.array([0.2, 0.4, 3.0]), np.array([-2.6, 0.8, 0.3]))
    poses = np.stack([look_at(eye, np.zeros(3)) for eye in eyes])
    lens = torch.tensor([[6.0, 0, 4.5], [0, 6, 4], [0, 0, 1]], dtype=torch.float64)
    rest = {
        "faces": scene["faces"],
        "world_to_camera": torch.from_numpy(poses)[None],
        "intrinsics": lens.expand(1, 2, 3, 3),
        "image_size": (8, 9),
        "sigma_px2": 0.6,
        "compositing": mode,
        "backend": backend,
    }
    alone = render_silhouettes(scene["vertices_m"], **rest | {"compositing": "alone"})
    assert (alone.flatten(3).sum(-1) > 1).all()  # both objects are seen in both views
    assert torch.autograd.gradcheck(
        lambda vertices: render_silhouettes(vertices, **rest),
        (scene["vertices_m"].requires_grad_(),),
        eps=1e-6,
        atol=1e-6,
        rtol=1e-5,
    )


@pytest.mark.parametrize("mode", compositing.MODES)
def test_compositing_passes_gradcheck(mode):
    generator = torch.Generator().manual_seed(4)
    coverage = torch.rand(2, 3, 2, 3, generator=generator, dtype=torch.float64).requires_grad_()
    depth = torch.rand(2, 3, 2, 3, generator=generator, dtype=torch.float64)
    depth[torch.rand(2, 3, 2, 3, generator=generator) < 0.2] = math.inf
    for engine in (compositing, reference):
        assert torch.autograd.gradcheck(
            lambda c, engine=engine: engine.composite(c, depth, mode), (coverage,)
        )


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="one core: nothing to compare")
def test_the_number_of_threads_changes_no_bit():
    scene = random_scene(5)
    before = numba.get_num_threads()
    results = []
    try:
        for count in (1, 2, 2):
            numba.set_num_threads(count)
            for dtype in (torch.float32, torch.float64):
                cast = {k: v.to(dtype) if k != "faces" else v for k, v in tensors(scene).items()}
                results.append(masks_and_gradient(scene | cast, sigma_px2=1.0))
    finally:
        numba.set_num_threads(before)
    for first, other in zip(results * 2, results[2:] + results[:2], strict=False):
        if first[0].dtype == other[0].dtype:
            assert torch.equal(first[0], other[0]) and torch.equal(first[1], other[1])


def tensors(scene: dict) -> dict:
    return {key: value for key, value in scene.items() if isinstance(value, torch.Tensor)}


@pytest.mark.parametrize("template", ["sphere", "box"])
def test_a_shifted_and_shrunk_object_walks_back_under_its_masks(template):
    """Three views, 90 steps of Adam on ever crisper masks: IoU of the hard masks above 0.9."""
    shape, faces = icosphere(1)
    shape = to_cube(shape) if template == "box" else shape
    truth = torch.tensor([[0.4, 0.5, -0.2], [0.7, 0.5, 0.4]])
    start = torch.tensor([[0.1, 0.7, 0.1], [0.4, 0.7, 0.7]])
    eyes = np.array([[0, 1, 3.0], [2.5, 1.2, 1.0], [-2.4, 1.5, 0.5]])
    poses = torch.from_numpy(np.stack([look_at(eye, np.array([0, 0.5, 0])) for eye in eyes]))
    lens = torch.tensor([[32.0, 0, 32], [0, 32, 24], [0, 0, 1]]).expand(1, 3, 3, 3)

    def masks(center, size, sigma_px2):
        vertices = (shape * size + center)[None, None]
        return render_silhouettes(
            vertices, faces, poses.float()[None], lens, (48, 64), sigma_px2=sigma_px2
        )

    observed = (masks(*truth, 1e-3) > 0.5).float()

    def iou(center, size):
        hard = masks(center, size, 1e-3) > 0.5
        return float((hard & (observed > 0)).sum() / (hard | (observed > 0)).sum())

    center = start[0].clone().requires_grad_()
    log_size = start[1].log().requires_grad_()
    assert iou(center.detach(), log_size.exp().detach()) < 0.5
    optimizer = torch.optim.Adam([center, log_size], lr=0.03)
    for sigma_px2 in [4.0] * 30 + [0.5] * 30 + [0.06] * 30:  # soft masks are too large
        soft = masks(center, log_size.exp(), sigma_px2).clamp(1e-6, 1 - 1e-6)
        loss = torch.nn.functional.binary_cross_entropy(soft, observed)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert iou(center.detach(), log_size.exp().detach()) > 0.9


def test_only_layered_lets_a_boundary_between_two_objects_push_the_front_one():
    # A small triangle well inside a large one that lies behind it: on screen, the front one's
    # edges are more than 5 px from the back one's.
    scene = triangles(
        [[-0.25, -0.2, 1], [0.3, -0.2, 1], [0, 0.25, 1]], [[-9, -5, 2], [9, -5, 2], [0, 9, 2]]
    )
    pulls = {}
    for mode in MODES:
        vertices = scene["vertices_m"].clone().requires_grad_()
        masks = render_silhouettes(
            **scene | {"vertices_m": vertices}, compositing=mode, sigma_px2=0.2
        )
        # Grow what is seen of the front object.
        masks[0, 0, 0].sum().backward()
        pulls[mode] = vertices.grad[0]
    assert pulls["alone"][0].abs().max() > 1
    # Nothing is nearer than the front object: seen as if alone, and the one behind has no say.
    assert_close(pulls["layered"][0], pulls["alone"][0], rtol=1e-12, atol=1e-12)
    assert pulls["layered"][1].abs().max() < 1e-12
    assert pulls["paper"].abs().max() < 1e-12


def test_layered_reveals_the_object_behind_as_the_front_one_shrinks():
    scene = triangles(
        [[-0.25, -0.2, 1], [0.3, -0.2, 1], [0, 0.25, 1]], [[-9, -5, 2], [9, -5, 2], [0, 9, 2]]
    )
    front, back = [], []
    for item, into in ((0, front), (1, back)):
        vertices = scene["vertices_m"].clone().requires_grad_()
        render_silhouettes(**scene | {"vertices_m": vertices}, sigma_px2=0.2)[
            0, 0, item
        ].sum().backward()
        into.append(vertices.grad[0, 0])
    # The back one fills the image: what the front one gains there, it loses.
    assert_close(back[0], -front[0], rtol=1e-9, atol=1e-9)


def test_a_vertex_that_is_no_number_names_object_and_room():
    for value in (math.nan, math.inf):
        scene = random_scene(0)
        scene["vertices_m"][1, 2, 3, 0] = value
        with pytest.raises(
            ValueError, match=r"^object 2 of room 1 has a vertex that is not finite"
        ):
            render_silhouettes(**scene)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"compositing": "soft"}, r"compositing is 'soft'; expected one of \('layered', 'paper'"),
        ({"sigma_px2": 0.0}, "sigma_px2 is 0.0; it must be positive"),
        ({"sigma_px2": math.nan}, "sigma_px2 is nan; it must be positive"),
        ({"backend": "cuda"}, "backend is 'cuda'; expected auto, cpu or reference"),
    ],
)
def test_wrong_settings_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        render_silhouettes(**random_scene(0), **options)


def test_the_package_exports_the_renderer_and_loads_torch_only_for_it():
    code = (
        "import sys\n"
        "import sceneprior.silhouettes.zbuffer\n"
        "assert 'torch' not in sys.modules\n"
        "from sceneprior.silhouettes import render_silhouettes\n"
        "assert render_silhouettes.__module__ == 'sceneprior.silhouettes.render'\n"
        "import sceneprior.silhouettes as package\n"
        "assert not hasattr(package, 'nonsense')\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
