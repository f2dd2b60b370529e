"""The public door: units, settings, errors, and who is in front of whom."""

import math

import numpy as np
import pytest
import torch
from silhouette_scenes import MODES, SIZE, cast, random_scene, sphere_scene
from torch.testing import assert_close
from toy_rooms import look_at

from sceneprior.core.proxies import icosphere
from sceneprior.render.offscreen.zbuffer import rasterize
from sceneprior.render.silhouettes.render import render_scene, render_silhouettes, sigma_from_ndc


def lumpy_room() -> dict:
    """Five lumpy balls that hide each other, two cameras that see all of them."""
    sphere, faces = icosphere(2)
    sphere = sphere.double()
    lumps = 1 + 0.3 * torch.sin(4 * sphere[:, :1] + 1) * torch.cos(5 * sphere[:, 1:2])
    rng = np.random.default_rng(3)
    places = torch.from_numpy(rng.uniform(-0.8, 0.8, (5, 1, 3)))
    sizes = torch.from_numpy(rng.uniform(0.2, 0.6, (5, 1, 3)))
    poses = np.stack([look_at(np.array(eye), np.zeros(3)) for eye in ([0, 0.6, 3.0], [2.5, 1, 1])])
    lens = torch.tensor([[60.0, 0, 41], [0, 55, 29], [0, 0, 1]], dtype=torch.float64)
    return {
        "vertices_m": (sphere * lumps * sizes + places)[None],
        "faces": faces,
        "world_to_camera": torch.from_numpy(poses)[None],
        "intrinsics": lens.expand(1, 2, 3, 3),
        "image_size": (60, 80),
    }


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("mode", MODES)
def test_front_and_depth_are_the_z_buffers(mode, dtype):
    scene = lumpy_room()
    vertices = cast(scene, dtype)["vertices_m"].clone().requires_grad_()
    drawn = render_scene(**cast(scene, dtype) | {"vertices_m": vertices}, mode=mode)
    assert drawn.front.dtype == torch.int32 and drawn.depth_m.dtype == dtype
    assert drawn.masks.requires_grad
    assert not drawn.front.requires_grad and not drawn.depth_m.requires_grad
    points = scene["vertices_m"][0]
    joined = torch.cat([scene["faces"] + item * points.shape[1] for item in range(5)]).numpy()
    for view in range(2):
        face, depth = rasterize(
            points.flatten(0, 1).numpy(),
            joined,
            scene["world_to_camera"][0, view].numpy(),
            (60.0, 55.0, 41.0, 29.0),
            (60, 80),
        )
        ids = np.where(face >= 0, face // len(scene["faces"]), -1)
        assert len(np.unique(ids)) == 6
        np.testing.assert_array_equal(drawn.front[0, view].numpy(), ids)
        # The z-buffer keeps 1 / z in float32.
        np.testing.assert_allclose(drawn.depth_m[0, view].detach().numpy(), depth, rtol=2e-6)


def test_a_pixel_centre_on_a_shared_edge_reads_three_quarters_in_the_exact_mode_alone():
    # Both faces may miss it: 1 - 0.5 * 0.5. Which of them contains it is left to rounding, so
    # `front` may name nobody there. The fast mode knows one shape, without a crack.
    square = torch.tensor([[-1.0, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]).double()
    scene = sphere_scene() | {
        "vertices_m": square[None, None] * torch.tensor([9, 9, 1]),
        "faces": torch.tensor([[0, 1, 2], [0, 2, 3]]),
    }
    for backend in ("cpu", "reference"):
        exact = render_scene(**scene, mode="exact", backend=backend)
        fast = render_scene(**scene, mode="fast", backend=backend)
        diagonal = exact.masks[0, 0, 0, range(24), range(4, 28)]
        assert_close(diagonal, torch.full_like(diagonal, 0.75), rtol=0, atol=1e-12)
        assert (fast.masks == 1).all() and (fast.front == 0).all() and (fast.depth_m == 1).all()


@pytest.mark.parametrize("mode", MODES)
def test_the_default_sigma_and_blur_are_the_authors_in_squared_ndc(mode):
    assert sigma_from_ndc(1e-4, (90, 120)) == pytest.approx(0.2025)  # from oracle_silhouettes.md
    assert sigma_from_ndc(1e-4, (240, 180)) == pytest.approx(0.81)
    scene, half = sphere_scene(), min(SIZE) / 2
    default = render_silhouettes(**scene, mode=mode)
    same = {"sigma_px2": 1e-4 * half**2, "blur_px2": math.log(1 / 1e-4 - 1) * 1e-4 * half**2}
    assert_close(render_silhouettes(**scene, mode=mode, **same), default, rtol=0, atol=1e-14)
    # A blur of r pixels reaches just so far, whatever the sigma. The pixel centre (16, 12) is
    # away from the outline by more; so is any that is covered by less than exp(-r**2 / sigma).
    options = {"mode": mode, "sigma_px2": 9.0, "compositing": "alone"}
    wide = render_silhouettes(**scene, **options)
    cut = render_silhouettes(**scene, **options, blur_px2=4.0)
    least = 1 / (1 + math.exp(4 / 9))
    assert (wide[cut == 0] < 1).all() and wide[(wide > 0) & (cut == 0)].numel() > 100
    assert cut[cut > 0].min() >= least - 1e-12
    if mode == "fast":
        kept = (cut > 0) & (cut < 1)
        assert torch.equal(cut[kept], wide[kept])


@pytest.mark.parametrize(
    ("which", "at", "value", "message"),
    [
        ("vertices_m", (1, 2, 3, 0), math.nan, "object 2 of room 1 has a vertex that is not"),
        ("vertices_m", (1, 2, 3, 0), -math.inf, "object 2 of room 1 has a vertex that is not"),
        ("world_to_camera", (1, 2, 0, 1), math.nan, "view 2 of room 1 has a pose or intrinsics th"),
        ("intrinsics", (1, 2, 0, 1), math.nan, "view 2 of room 1 has a pose or intrinsics that"),
        ("faces", (3, 1), -1, "faces name vertices -1 to 8, but each object has vertices 0 to 8"),
        ("faces", (3, 1), 9, "faces name vertices 0 to 9, but each object has vertices 0 to 8"),
    ],
)
def test_what_is_no_number_or_no_vertex_is_named(which, at, value, message):
    scene = random_scene(0)
    scene[which] = scene[which].clone()
    scene[which][at] = value
    with pytest.raises(ValueError, match=f"^{message}"):
        render_silhouettes(**scene)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"mode": "quick"}, "mode is 'quick'; expected exact or fast"),
        ({"compositing": "soft"}, "compositing is 'soft'; expected layered, paper or alone"),
        ({"backend": "mps"}, "backend is 'mps'; expected auto, cpu, cuda or reference"),
        ({"image_size": (0, 8)}, r"image_size is \(0, 8\); both sides must be at least 1"),
        ({"sigma_px2": 0.0}, "sigma_px2 is 0.0; it must be positive"),
        ({"blur_px2": -1.0}, "blur_px2 is -1.0; it must not be negative"),
    ],
)
def test_wrong_settings_are_named(options, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        render_scene(**random_scene(0) | options)
