"""The differentiable renderer: soft visible masks of meshes in many views, with gradients."""

import importlib
import math
from typing import Any, NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from sceneprior.core.cameras import project
from sceneprior.render.silhouettes.reference import Settings

NEAR_FACE_M = 0.05
"""Minimum depth in metres; a face with a nearer corner is not drawn in that view."""

SIGMA_NDC = 1e-4
"""The paper's blend sigma, in squared NDC (the shorter image side spans [-1, 1])."""

MODES = ("exact", "fast")
COMPOSITING = ("layered", "paper", "alone")
BACKENDS = ("auto", "cpu", "cuda", "reference")


class RenderedScene(NamedTuple):
    """The result of `render_scene`; `front` and `depth_m` are hard and carry no gradient."""

    masks: Float[Tensor, "rooms views objects height width"]
    """Soft masks in [0, 1], differentiable in the vertices."""
    front: Int[Tensor, "rooms views height width"]
    """Index, among the room's objects, of the nearest object at each pixel centre; -1 for none."""
    depth_m: Float[Tensor, "rooms views height width"]
    """Depth of the nearest object along the optical axis; infinite for none."""


def sigma_from_ndc(sigma_ndc: float, image_size: tuple[int, int]) -> float:
    """Convert PyTorch3D's squared NDC (the shorter image side spans [-1, 1]) to squared pixels."""
    return sigma_ndc * (min(image_size) / 2) ** 2


def render_scene(
    vertices_m: Float[Tensor, "rooms objects vertices 3"],
    faces: Int[Tensor, "faces 3"],
    world_to_camera: Float[Tensor, "rooms views 4 4"],
    intrinsics: Float[Tensor, "rooms views 3 3"],
    image_size: tuple[int, int],
    *,
    sigma_px2: float | None = None,
    blur_px2: float | None = None,
    mode: str = "exact",
    compositing: str = "layered",
    drawn: Bool[Tensor, "rooms objects"] | None = None,
    backend: str = "auto",
) -> RenderedScene:
    """Draw every object's soft mask, and find the nearest object, in every view of its room.

    In `exact` mode a pixel is covered unless every face misses it:

        coverage = 1 - prod_f (1 - sigmoid(s_f * d_f / sigma))

    d_f is the squared distance in pixels from the pixel centre to the nearest edge of the projected
    face f, and s_f is +1 inside the face and -1 outside. A face whose distance to an outside pixel
    exceeds the blur radius is left out of the product, as in the authors' code. There is no limit
    on faces per pixel.

    In `fast` mode the mesh is one shape: coverage = sigmoid(s * d / sigma), d the squared distance
    to its outline. Interior edges do not contribute, so a fine mesh does not fatten the masks, and
    the cost does not grow with the blur (docs/silhouettes.md).

    Args:
        vertices_m: World positions in metres; all objects share one topology.
        faces: Corners of each triangle. Both sides are drawn; the mesh need not be closed.
        world_to_camera: One rigid transform per view, OpenCV axes.
        intrinsics: Intrinsics in pixels of an image of `image_size`.
        image_size: (height, width) of the masks.
        sigma_px2: Softness of an edge in squared pixels. Larger values blur more, and give more
            pixels a gradient. None uses the paper's, 1e-4 in squared NDC (`sigma_from_ndc`).
        blur_px2: Squared blur radius in squared pixels; None uses the authors' value, log(1 / 1e-4
            - 1) * sigma, at which the sigmoid is 1e-4.
        mode: `exact` or `fast`.
        compositing: Treatment of occlusion. `layered` (alpha compositing) and `paper` give visible
            masks, see `cpu/backend.py`. `alone` draws each object as if there were no others.
        drawn: True for the objects to draw; the others get empty masks and occlude nothing. None
            draws all objects.
        backend: `cpu` (Numba), `cuda` (Triton), `reference` (plain torch), or `auto`: `cpu` or
            `cuda` by the device of the vertices, on other devices `reference`.

    Raises:
        ValueError: an unknown mode, a sigma that is not positive, a vertex index out of range, or a
            vertex or camera that is not finite.
        ImportError: the backend is `cuda`, or `auto` with CUDA tensors, and Triton is missing.

    Source:
        Liu et al., "Soft Rasterizer", ICCV 2019; the paper's supplement A.

    Example: a triangle with 1 m legs, 2 m ahead, at 32 px focal length covers 16 * 16 / 2 px.

        >>> triangle = torch.tensor([[[[0.0, 0, 2], [1, 0, 2], [0, 1, 2]]]])
        >>> ahead = torch.eye(4)[None, None]
        >>> intrinsics = torch.tensor([[[[32.0, 0, 16], [0, 32, 16], [0, 0, 1]]]])
        >>> scene = render_scene(
        ...     triangle, torch.tensor([[0, 1, 2]]), ahead, intrinsics, (32, 32), sigma_px2=1e-3
        ... )
        >>> scene.masks.shape, round(scene.masks.sum().item(), 3)
        (torch.Size([1, 1, 1, 32, 32]), 128.0)
        >>> scene.front[0, 0, 20, ::4].tolist()
        [-1, -1, -1, -1, 0, 0, 0, -1]
    """
    for name, value, known in (
        ("mode", mode, MODES),
        ("compositing", compositing, COMPOSITING),
        ("backend", backend, BACKENDS),
    ):
        if value not in known:
            raise ValueError(
                f"{name} is '{value}'; expected {', '.join(known[:-1])} or {known[-1]}"
            )
    if min(image_size) < 1:
        raise ValueError(f"image_size is {tuple(image_size)}; both sides must be at least 1")
    if sigma_px2 is None:
        sigma_px2 = sigma_from_ndc(SIGMA_NDC, image_size)
    if not sigma_px2 > 0:
        raise ValueError(f"sigma_px2 is {sigma_px2}; it must be positive")
    if blur_px2 is None:
        blur_px2 = math.log(1 / 1e-4 - 1) * sigma_px2
    if not blur_px2 >= 0:
        raise ValueError(f"blur_px2 is {blur_px2}; it must not be negative")
    rooms, objects = vertices_m.shape[:2]
    views = world_to_camera.shape[1]
    _check_values(vertices_m, faces, world_to_camera, intrinsics)
    if drawn is None:
        drawn = torch.ones(rooms, objects, dtype=torch.bool, device=vertices_m.device)
    if backend == "auto":
        backend = vertices_m.device.type
        backend = backend if backend in BACKENDS else "reference"
    moving_cameras = world_to_camera.requires_grad or intrinsics.requires_grad
    if backend == "cpu" and not moving_cameras:
        from sceneprior.render.silhouettes.cpu.backend import project_in_threads

        pixels, depths = project_in_threads(vertices_m, world_to_camera, intrinsics)
    else:
        projected = project(vertices_m, world_to_camera, intrinsics).flatten(0, 1)
        pixels, depths = projected[..., :2], projected[..., 2]
    # Imported when needed: the CPU backend compiles, and Triton may not be installed.
    module = backend if backend == "reference" else f"{backend}.backend"
    engine = importlib.import_module(f"sceneprior.render.silhouettes.{module}")
    size = (image_size[0], image_size[1])
    settings = Settings(size, sigma_px2, blur_px2, NEAR_FACE_M, mode, compositing)
    drawn = drawn.repeat_interleave(views, dim=0)
    images = engine.draw(pixels, depths, faces, drawn, settings)
    return RenderedScene(*(array.unflatten(0, (rooms, views)) for array in images))


def _check_values(
    vertices_m: Tensor, faces: Tensor, world_to_camera: Tensor, intrinsics: Tensor
) -> None:
    finite = torch.isfinite(vertices_m).flatten(2).all(dim=-1)
    seen = torch.isfinite(world_to_camera).flatten(2).all(-1)
    seen &= torch.isfinite(intrinsics).flatten(2).all(-1)
    vertices = vertices_m.shape[2]
    known = (faces >= 0) & (faces < vertices)
    if bool(torch.stack([finite.all(), seen.all(), known.all()]).all()):  # waits for a GPU once
        return
    if not bool(finite.all()):
        room, item = (~finite).nonzero()[0].tolist()
        raise ValueError(f"object {item} of room {room} has a vertex that is not finite")
    if not bool(seen.all()):
        room, view = (~seen).nonzero()[0].tolist()
        raise ValueError(f"view {view} of room {room} has a pose or intrinsics that is not finite")
    raise ValueError(
        f"faces name vertices {int(faces.min())} to {int(faces.max())}, but each object has "
        f"vertices 0 to {vertices - 1}"
    )


def render_silhouettes(*args: Any, **kwargs: Any) -> Tensor:
    """The masks of `render_scene`, which documents the arguments and errors."""
    return render_scene(*args, **kwargs).masks
