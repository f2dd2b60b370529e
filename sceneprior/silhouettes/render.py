"""Meshes and cameras in, soft masks out: the public door of the differentiable renderer."""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.geometry.cameras import project
from sceneprior.silhouettes import compositing as fast_compositing
from sceneprior.silhouettes import cpu, reference

NEAR_M = 0.05
"""A face with a corner nearer than this, or behind the camera, is left out of that view."""

SIGMA_NDC = 1e-4
"""The paper's blend sigma, in squared NDC (the shorter image side spans [-1, 1])."""

COMPOSITING = (*fast_compositing.MODES, "alone")


def sigma_from_ndc(sigma_ndc: float, image_size: tuple[int, int]) -> float:
    """PyTorch3D's squared-NDC sigma in squared pixels."""
    return sigma_ndc * (min(image_size) / 2) ** 2


def render_silhouettes(
    vertices_m: Float[Tensor, "rooms objects vertices 3"],
    faces: Int[Tensor, "faces 3"],
    world_to_camera: Float[Tensor, "rooms views 4 4"],
    intrinsics: Float[Tensor, "rooms views 3 3"],
    image_size: tuple[int, int],
    *,
    sigma_px2: float | None = None,
    compositing: str = "layered",
    drawn: Bool[Tensor, "rooms objects"] | None = None,
    backend: str = "auto",
) -> Float[Tensor, "rooms views objects height width"]:
    """Draw every object's soft mask in every view of its room.

    A pixel is covered unless every face misses it:

        coverage = 1 - prod_f (1 - sigmoid(s_f * d_f / sigma))

    d_f is the squared distance in pixels from the pixel centre to the nearest edge of the
    projected face f, s_f is +1 inside the face and -1 outside. Outside, faces farther than
    the blur radius (where the sigmoid is 1e-4) do not count, as in the authors' code. There is
    no limit on faces per pixel.

    Args:
        vertices_m: World positions in metres; all objects share one topology.
        faces: Corners of each triangle.
        world_to_camera: One rigid transform a view, OpenCV axes.
        intrinsics: Pixels of an image of `image_size`.
        image_size: (height, width) of the masks.
        sigma_px2: Softness of an edge in squared pixels; None takes the paper's 1e-4 squared
            NDC. Larger pulls on more pixels and blurs more.
        compositing: `layered` or `paper` (visible masks, see `compositing.py`), or `alone`.
        drawn: Objects to draw; others are empty and hide nothing. None draws all.
        backend: `cpu` (Numba), `reference` (plain torch), or `auto`: Numba where it can run.

    Returns:
        Masks in [0, 1], differentiable in `vertices_m`.

    Raises:
        ValueError: an unknown mode, a sigma that is not positive, or a vertex that is not finite.

    Source:
        Liu et al., "Soft Rasterizer", ICCV 2019; the paper's supplement A.

    Example: a triangle with 1 m legs, 2 m ahead, at 32 px focal length covers 16 * 16 / 2 px.

        >>> triangle = torch.tensor([[[[0.0, 0, 2], [1, 0, 2], [0, 1, 2]]]])
        >>> ahead = torch.eye(4)[None, None]
        >>> lens = torch.tensor([[[[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]]])
        >>> masks = render_silhouettes(
        ...     triangle, torch.tensor([[0, 1, 2]]), ahead, lens, (32, 32), sigma_px2=1e-3
        ... )
        >>> masks.shape, round(masks.sum().item(), 3)
        (torch.Size([1, 1, 1, 32, 32]), 128.0)
    """
    if compositing not in COMPOSITING:
        raise ValueError(f"compositing is '{compositing}'; expected one of {COMPOSITING}")
    if sigma_px2 is None:
        sigma_px2 = sigma_from_ndc(SIGMA_NDC, image_size)
    if not sigma_px2 > 0:
        raise ValueError(f"sigma_px2 is {sigma_px2}; it must be positive")
    finite = torch.isfinite(vertices_m).flatten(2).all(dim=-1)
    if not bool(finite.all()):
        room, item = (~finite).nonzero()[0].tolist()
        raise ValueError(f"object {item} of room {room} has a vertex that is not finite")
    rooms, objects = vertices_m.shape[:2]
    views = world_to_camera.shape[1]
    if drawn is None:
        drawn = torch.ones(rooms, objects, dtype=torch.bool, device=vertices_m.device)
    projected = project(vertices_m, world_to_camera, intrinsics).flatten(0, 2)
    engine, compose = _backend(backend, vertices_m)
    coverage, depth = engine.soft_coverage(
        projected[..., :2],
        projected[..., 2],
        faces,
        drawn.unsqueeze(1).expand(-1, views, -1).flatten(),
        image_size,
        sigma_px2,
        math.log(1 / 1e-4 - 1) * sigma_px2,
        NEAR_M,
    )
    shape = (rooms * views, objects, *image_size)
    if compositing != "alone":
        coverage = compose(coverage.reshape(shape), depth.reshape(shape), compositing)
    return coverage.reshape(rooms, views, objects, *image_size)


def _backend(name: str, like: Tensor):
    if name == "auto":
        name = "cpu" if like.device.type == "cpu" else "reference"
    if name == "cpu":
        return cpu, fast_compositing.composite
    if name == "reference":
        return reference, reference.composite
    raise ValueError(f"backend is '{name}'; expected auto, cpu or reference")
