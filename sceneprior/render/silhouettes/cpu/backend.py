"""The Numba backend: projection, visible masks of projected meshes, and their gradients."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneprior.core.cameras import MIN_DEPTH_M
from sceneprior.render.silhouettes.cpu import compositing, faces, outline
from sceneprior.render.silhouettes.cpu.kernels import in_threads, windows_of
from sceneprior.render.silhouettes.reference import Drawing, Settings


@njit(cache=True, nogil=True, error_model="numpy")
def _project(first, last, points, cameras, views, pixels, depths):
    least = points.dtype.type(MIN_DEPTH_M)
    for image in range(first, last):
        m = cameras[image]
        for k in range(points.shape[1]):
            x, y, z = points[image // views, k]
            depth = m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]
            over = 1 / max(depth, least)
            pixels[image, k, 0] = (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]) * over
            pixels[image, k, 1] = (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]) * over
            depths[image, k] = depth


@njit(cache=True, nogil=True, error_model="numpy")
def _project_backward(first, last, cameras, pixels, depths, objects, upstream, gradient):
    """Add dL/dpoints to `gradient`. Items are objects, so each vertex belongs to one thread."""
    rooms, points, _ = gradient.shape
    views, each = cameras.shape[0] // rooms, points // objects
    least = gradient.dtype.type(MIN_DEPTH_M)
    for item in range(first, last):
        room, start = item // objects, item % objects * each
        for image in range(room * views, (room + 1) * views):
            m = cameras[image]
            for k in range(start, start + each):
                upstream_u, upstream_v = upstream[image, k]
                if upstream_u == 0 and upstream_v == 0:
                    continue
                over = 1 / max(depths[image, k], least)
                along = upstream_u * pixels[image, k, 0] + upstream_v * pixels[image, k, 1]
                along = along if depths[image, k] > least else along * 0
                for axis in range(3):
                    gradient[room, k, axis] += over * (
                        upstream_u * m[0, axis] + upstream_v * m[1, axis] - along * m[2, axis]
                    )


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, points_m, cameras, views):
        rooms, objects, each, _ = points_m.shape
        images = cameras.shape[0]
        points = points_m.detach().reshape(rooms, objects * each, 3).contiguous().numpy()
        matrices = cameras.contiguous().numpy()
        pixels = np.empty((images, objects * each, 2), dtype=points.dtype)
        depths = np.empty((images, objects * each), dtype=points.dtype)
        in_threads(_project, images, points, matrices, views, pixels, depths)
        ctx.rest = (matrices, pixels, depths, objects)
        ctx.shape = points_m.shape
        shape = (images, objects, each)
        result = torch.from_numpy(pixels).view(*shape, 2), torch.from_numpy(depths).view(shape)
        ctx.mark_non_differentiable(result[1])
        return result

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream, _depths):
        matrices, pixels, depths, objects = ctx.rest
        rooms, _, each, _ = ctx.shape
        gradient = np.zeros((rooms, objects * each, 3), dtype=pixels.dtype)
        upstream = upstream.contiguous().numpy().reshape(pixels.shape)
        items = rooms * objects
        in_threads(_project_backward, items, matrices, pixels, depths, objects, upstream, gradient)
        return torch.from_numpy(gradient).view(ctx.shape), None, None


def project_in_threads(
    points_m: Float[Tensor, "rooms objects points 3"],
    world_to_camera: Float[Tensor, "rooms views 4 4"],
    intrinsics: Float[Tensor, "rooms views 3 3"],
) -> tuple[Float[Tensor, "images objects points 2"], Float[Tensor, "images objects points"]]:
    """u, v in pixels and depth in metres of every point in every view of its room.

    u and v are differentiable in `points_m` alone; the depths carry no gradient.
    """
    cameras = (intrinsics @ world_to_camera[..., :3, :]).detach().flatten(0, 1)
    return _Project.apply(points_m, cameras, world_to_camera.shape[1])


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, pixels, depths, triangles, drawn, settings):
        points, z = (part.detach().flatten(0, 1).contiguous().numpy() for part in (pixels, depths))
        windows = windows_of(points, z, drawn.contiguous().flatten().numpy(), settings)
        arguments = (points, z, triangles.contiguous().numpy(), windows, settings)
        engine = outline if settings.mode == "fast" else faces
        odds, order, traced = engine.cover(*arguments)
        size = (*pixels.shape[:2], *settings.image_size)
        composed = compositing.compose(odds, order, windows, settings.compositing, size)
        ctx.rest = (engine, arguments, odds, order, traced)
        results = tuple(torch.from_numpy(array) for array in composed)
        ctx.mark_non_differentiable(*results[1:])
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream, _front, _depth):
        engine, arguments, odds, order, traced = ctx.rest
        windows, settings = arguments[3:]
        packed = compositing.compose_backward(
            odds, order, windows, settings.compositing, upstream.contiguous().numpy()
        )
        gradient = engine.cover_backward(*arguments, odds, traced, packed)
        gradient = gradient.reshape(*upstream.shape[:2], *gradient.shape[1:])
        return torch.from_numpy(gradient), None, None, None, None


def draw(
    pixels: Float[Tensor, "images objects vertices 2"],
    depths: Float[Tensor, "images objects vertices"],
    triangles: Int[Tensor, "faces 3"],
    drawn: Bool[Tensor, "images objects"],
    settings: Settings,
) -> Drawing:
    """Draw as `reference.draw` does, with Numba."""
    return Drawing(*_Draw.apply(pixels, depths, triangles.long(), drawn, settings))
