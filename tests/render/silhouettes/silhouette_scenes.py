"""Scenes that the tests of the renderer draw, and how they compare two results."""

import numpy as np
import torch
from toy_rooms import look_at

from sceneprior.core.proxies import icosphere
from sceneprior.render.silhouettes.render import render_scene

MODES = ("exact", "fast")
COMPOSITING = ("layered", "paper", "alone")
SIZE = (24, 32)
LENS = torch.tensor([[16.0, 0, 16], [0, 16, 12], [0, 0, 1]], dtype=torch.float64)
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
    return seen_ahead((sphere.double() * 0.6 + centers[:, None]), faces)


def seen_ahead(vertices_m: torch.Tensor, faces: torch.Tensor, size=SIZE, focal_px=16.0) -> dict:
    """Objects (objects, vertices, 3) in camera space, before one camera."""
    height, width = size
    lens = torch.tensor([[focal_px, 0, width / 2], [0, focal_px, height / 2], [0, 0, 1]])
    return {
        "vertices_m": vertices_m.double()[None],
        "faces": faces,
        "world_to_camera": FRONT,
        "intrinsics": lens.double()[None, None],
        "image_size": size,
    }


def triangles(*corners) -> dict:
    """A triangle in camera space as the only object."""
    return seen_ahead(torch.tensor(corners, dtype=torch.float64), torch.tensor([[0, 1, 2]]))


def one_triangle_over_another() -> dict:
    """A small triangle well inside a large one that lies behind it: on screen, the front one's
    edges are more than 5 px from the back one's."""
    return triangles(
        [[-0.25, -0.2, 1], [0.3, -0.2, 1], [0, 0.25, 1]], [[-9, -5, 2], [9, -5, 2], [0, 9, 2]]
    )


def cast(scene: dict, dtype: torch.dtype) -> dict:
    """The same scene in another precision."""
    floats = {
        key: value.to(dtype)
        for key, value in scene.items()
        if isinstance(value, torch.Tensor) and value.is_floating_point()
    }
    return scene | floats


def render_and_grad(scene: dict, **options) -> tuple:
    """Masks, front, depth and the gradient of a random weighing of the masks."""
    vertices = scene["vertices_m"].clone().requires_grad_()
    drawn = render_scene(**scene | {"vertices_m": vertices}, **options)
    generator = torch.Generator().manual_seed(1)
    upstream = torch.randn(drawn.masks.shape, generator=generator, dtype=torch.float64)
    (drawn.masks * upstream.to(drawn.masks.dtype)).sum().backward()
    return drawn.masks.detach(), drawn.front, drawn.depth_m, vertices.grad
