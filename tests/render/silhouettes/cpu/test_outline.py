"""The fast mode against shapely: the union of the projected faces is one shape, soft at its rim."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import shapely
import torch
import trimesh
from references.silhouettes import junctions, shape_coverage, shape_of
from silhouette_scenes import seen_ahead, triangles
from torch import Tensor

from sceneprior.core.cameras import project
from sceneprior.core.proxies import icosphere
from sceneprior.render.silhouettes.reference import PIECE_PX
from sceneprior.render.silhouettes.render import render_silhouettes

AHEAD = torch.tensor([0.03, -0.02, 3.0])
SIZE = (48, 64)
FOCAL_PX = 40.0


def turned(points: Tensor) -> Tensor:
    spin = torch.tensor([[0, -0.3, 0.5], [0.3, 0, -0.7], [-0.5, 0.7, 0]])
    return points @ torch.linalg.matrix_exp(spin).T


def ellipsoid() -> tuple[Tensor, Tensor]:
    sphere, faces = icosphere(3)
    return turned(sphere * torch.tensor([0.4, 0.9, 0.6])), faces


def bent() -> tuple[Tensor, Tensor]:
    """A banana."""
    sphere, faces = icosphere(3)
    points = sphere * torch.tensor([1.1, 0.25, 0.3])
    points[:, 1] += 0.9 * points[:, 0] ** 2 - 0.5
    return turned(points), faces


def lumpy() -> tuple[Tensor, Tensor]:
    """Lumps before lumps: inner contours."""
    sphere, faces = icosphere(3)
    lumps = 1 + 0.35 * torch.sin(4 * sphere[:, :1] + 1) * torch.cos(5 * sphere[:, 1:2])
    return turned(sphere * lumps) * 0.8, faces


def torus(tilt_rad: float) -> tuple[Tensor, Tensor]:
    ring = trimesh.creation.torus(0.8, 0.25, major_sections=24, minor_sections=12)
    cos, sin = math.cos(tilt_rad), math.sin(tilt_rad)
    tilt = torch.tensor([[1, 0, 0], [0, cos, -sin], [0, sin, cos]])
    return torch.tensor(ring.vertices).float() @ tilt.T, torch.tensor(ring.faces)


def half_sphere() -> tuple[Tensor, Tensor]:
    sphere, faces = icosphere(3)
    return turned(sphere), faces[sphere[faces][:, :, 2].mean(dim=-1) < 0.1]


def soup(seed: int) -> tuple[Tensor, Tensor]:
    """Twelve triangles without a common corner, among each other."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(0, 0.5, (12, 1, 3)) + rng.normal(0, 0.4, (12, 3, 3))
    return torch.tensor(corners.reshape(-1, 3) * [1, 1, 0.3]).float(), torch.arange(36).view(12, 3)


def shape_seen(scene: dict) -> tuple[shapely.Geometry, np.ndarray]:
    seen = project(scene["vertices_m"], scene["world_to_camera"], scene["intrinsics"])[0, 0, 0]
    pixels = seen[:, :2].detach().numpy()
    return shape_of(pixels, seen[:, 2].detach().numpy(), scene["faces"].numpy()), pixels


def compare(points: Tensor, faces: Tensor, sigma_px2: float) -> tuple[np.ndarray, ...]:
    """Differences to the oracle, the oracle, and how far each pixel is from a junction."""
    scene = seen_ahead((points + AHEAD)[None], faces, SIZE, FOCAL_PX)
    shape, pixels = shape_seen(scene)
    blur_px2 = math.log(1 / 1e-4 - 1) * sigma_px2
    wanted = shape_coverage(shape, SIZE, sigma_px2, blur_px2)
    mask = render_silhouettes(**scene, mode="fast", sigma_px2=sigma_px2, backend="cpu")
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]] + 0.5
    apart = np.full(SIZE, np.inf)
    for u, v in junctions(shape, pixels):
        apart = np.minimum(apart, np.hypot(columns - u, rows - v))
    return np.abs(mask[0, 0, 0].numpy() - wanted), wanted, apart - math.sqrt(blur_px2)


@pytest.mark.parametrize("sigma_px2", [0.1, 1.0])
@pytest.mark.parametrize(
    "mesh",
    [
        *(lambda level=level: icosphere(level) for level in (0, 1, 2, 3)),
        ellipsoid,
        half_sphere,
        lambda: torus(1.5),
    ],
    ids=["ball0", "ball1", "ball2", "ball3", "ellipsoid", "half ball", "torus edge on"],
)
def test_a_mesh_without_crossing_contours_is_the_oracle(
    mesh: Callable[[], tuple[Tensor, Tensor]], sigma_px2: float
):
    difference, wanted, _ = compare(*mesh(), sigma_px2)
    assert (wanted > 0.5).sum() > 150
    # Seen 5e-16: the same float64 distances.
    assert difference.max() < 1e-12


@pytest.mark.parametrize("sigma_px2", [0.1, 1.0])
@pytest.mark.parametrize(
    ("mesh", "share"),
    [
        # `share` of the soft pixels differ by more than 0.01; seen two thirds of it.
        (bent, 0.08),
        (lumpy, 0.1),
        (lambda: torus(0.3), 0.02),
        (lambda: torus(0.8), 0.06),
        (lambda: torus(1.2), 0.06),
        *((lambda seed=seed: soup(seed), 0.15) for seed in range(4)),
    ],
    ids=["bent", "lumpy", "torus 0.3", "torus 0.8", "torus 1.2", *(f"soup {k}" for k in range(4))],
)
def test_where_contours_cross_only_the_pieces_around_the_crossing_differ(
    mesh: Callable[[], tuple[Tensor, Tensor]], share: float, sigma_px2: float
):
    # A piece of an edge, 4 px at most, is outline as a whole or not at all: where two edges
    # cross, up to 2 px too much or too little. Nothing else may differ: no inner contour.
    difference, wanted, beyond_reach = compare(*mesh(), sigma_px2)
    wrong = difference > 1e-12
    soft = (wanted > 0) & (wanted < 1)
    assert (beyond_reach[wrong] < PIECE_PX).all()
    assert (difference > 0.01).sum() < share * soft.sum()
    # Never more than half: a pixel changes its distance, not its side.
    assert difference.max() < 0.5


def test_one_large_triangle_is_the_exact_modes():
    # One face has no inner edges. Beyond the blur radius inside, exact is within 1e-4 of 1.
    scene = triangles([[-0.9, -0.6, 1.5], [0.95, -0.3, 1.1], [-0.1, 0.8, 1.9]])
    for backend in ("cpu", "reference"):
        exact, fast = (
            render_silhouettes(**scene, mode=mode, sigma_px2=0.8, backend=backend)
            for mode in ("exact", "fast")
        )
        deep = fast == 1
        assert deep.sum() > 10 and (exact[deep] > 1 - 1e-4).all()
        torch.testing.assert_close(fast[~deep], exact[~deep], rtol=0, atol=1e-12)
        wide = {"sigma_px2": 0.8, "blur_px2": 1296.0, "backend": backend}  # no end
        exact, fast = (render_silhouettes(**scene, mode=m, **wide) for m in ("exact", "fast"))
        torch.testing.assert_close(fast, exact, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("move", "at"),
    [
        ("right", [0.0, 0.0, 3.0]),
        ("right", [1.9, 0.2, 3.0]),  # off the right edge
        ("down", [0.1, 1.3, 3.0]),  # off the lower edge
        ("grow", [0.1, 0.0, 3.0]),
        ("grow", [-1.9, 1.2, 3.0]),  # off a corner
        ("near", [0.2, -0.1, 3.0]),
    ],
)
def test_the_gradient_of_the_masks_sum_is_the_growth_of_the_shape(move, at):
    sphere, faces = icosphere(2)
    sphere = turned(sphere).double()
    image = shapely.box(0, 0, SIZE[1], SIZE[0])

    def scene_of(amount: Tensor) -> dict:
        center = torch.tensor(at, dtype=torch.float64)
        direction = {"right": [1.0, 0, 0], "down": [0, 1.0, 0], "near": [0, 0, -1.0]}
        center = center + amount * torch.tensor(direction.get(move, [0.0, 0, 0])).double()
        size = 1 + amount * (move == "grow")
        return seen_ahead((sphere * size + center)[None], faces, SIZE, FOCAL_PX)

    def area(amount: float) -> float:
        return shape_seen(scene_of(torch.tensor(amount)))[0].intersection(image).area

    growth = (area(1e-4) - area(-1e-4)) / 2e-4
    for backend in ("cpu", "reference"):
        amount = torch.zeros((), dtype=torch.float64, requires_grad=True)
        masks = render_silhouettes(**scene_of(amount), mode="fast", sigma_px2=1.0, backend=backend)
        masks.sum().backward()
        # 2% of the growth, and 2 px2 per metre where a move of 13 px leaves the area as it is:
        # the sum samples an integral at pixel centres. Seen 0.9%, and 1.0 px2.
        assert abs(float(amount.grad) - growth) < 0.02 * abs(growth) + 2
    assert abs(growth) > 300 or (move == "right" and at[0] == 0)
