"""The Numba backend: projection, visible masks of projected meshes, and their gradients.

The coverage of object k, drawn alone, is coverage_k = 1 - 1 / odds_k. There are three modes:

`alone`: the mask of an object is its coverage, without occlusion.

`paper`: the coverage of the whole scene, assigned to the front-most object of each pixel. The loss
cannot shift the boundary between two objects that touch in the image.

`layered`: alpha compositing. Object k is visible where it covers a pixel and no nearer object does,

    visible_k = coverage_k * prod_{j nearer than k} (1 - coverage_j),

so a loss at the boundary between two objects moves the front one, which reveals or hides the one
behind.

Objects are ordered by their depth at the pixel (see faces.py); the order carries no gradient.
"""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numba import njit
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneprior.core.cameras import MIN_DEPTH_M
from sceneprior.render.silhouettes.cpu import faces, outline
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


MODES = ("alone", "layered", "paper")
ALONE, LAYERED, PAPER = range(3)


@njit(inline="always")
def _in_row(bounds, origin, objects, row, here):
    """Write to `here` the objects whose window meets an image row, and return their number."""
    count = 0
    for k in range(objects):
        if bounds[origin + k, 0] <= row < bounds[origin + k, 1]:
            here[count] = k
            count += 1
    return count


@njit(inline="always")
def _in_strip(bounds, starts, origin, row, strip, here, count, who, where):
    """Write to `who` the objects of `here` whose window meets a strip, and to `where` the offset of
    the strip's row in their buffers; return their number."""
    found = 0
    for i in range(count):
        mesh = origin + here[i]
        if bounds[mesh, 2] <= strip < bounds[mesh, 3]:
            rows = bounds[mesh, 1] - bounds[mesh, 0]
            step = (strip - bounds[mesh, 2]) * rows + row - bounds[mesh, 0]
            who[found] = here[i]
            where[found] = starts[mesh] + step * 8
            found += 1
    return found


@njit(inline="always")
def _sort(order, where, found, lane, sequence, depth):
    """Sort the objects that touch a pixel, nearest first; insertion sort, since they are few."""
    count = 0
    for i in range(found):
        value = order[where[i] + lane]
        if value == -np.inf:
            continue
        z = 1.0 / value if value > 0.0 else -value
        place = count
        while place > 0 and depth[place - 1] > z:
            sequence[place], depth[place] = sequence[place - 1], depth[place - 1]
            place -= 1
        sequence[place], depth[place] = i, z
        count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _compose(first, last, odds, order, bounds, starts, mode, visible, front, front_depth):
    """Compute the visible masks, the front-most object and its depth of images[first:last].

    Inputs are packed in windows. Results are written to arrays over whole images, which the caller
    initialises: `visible` with 0, `front` with -1 and `front_depth` with inf.
    """
    _, objects, height, width = visible.shape
    T = visible.dtype.type
    one = T(1)
    for image in range(first, last):
        origin = image * objects
        here = np.empty(objects, dtype=np.int64)
        who, where = np.empty(objects, dtype=np.int64), np.empty(objects, dtype=np.int64)
        sequence, depth = np.empty(objects, dtype=np.int64), np.empty(objects)
        for row in range(height):
            in_row = _in_row(bounds, origin, objects, row, here)
            for strip in range((width + 7) // 8 if in_row > 0 else 0):
                found = _in_strip(bounds, starts, origin, row, strip, here, in_row, who, where)
                lanes = min(8, width - strip * 8)
                for i in range(found):
                    for lane in range(lanes):
                        nearness = order[where[i] + lane]
                        column = strip * 8 + lane
                        if nearness > 0.0 and one / nearness < front_depth[image, row, column]:
                            front_depth[image, row, column] = one / nearness
                            front[image, row, column] = who[i]
                if mode == ALONE or found == 1:
                    for i in range(found):
                        for lane in range(lanes):
                            visible[image, who[i], row, strip * 8 + lane] = (
                                one - one / odds[where[i] + lane]
                            )
                    continue
                for lane in range(lanes if found > 0 else 0):
                    column = strip * 8 + lane
                    left = one
                    for place in range(_sort(order, where, found, lane, sequence, depth)):
                        i = sequence[place]
                        missed = one / odds[where[i] + lane]
                        if mode == LAYERED:
                            visible[image, who[i], row, column] = left * (one - missed)
                        left *= missed
                    if mode == PAPER and left < one:
                        visible[image, who[sequence[0]], row, column] = one - left


@njit(cache=True, nogil=True, error_model="numpy")
def _compose_backward(first, last, odds, order, bounds, starts, mode, upstream, packed):
    """Compute -dL/dlog(missed), packed in windows, from the dense dL/dvisible."""
    _, objects, height, width = upstream.shape
    T = upstream.dtype.type
    one, zero = T(1), T(0)
    for image in range(first, last):
        origin = image * objects
        here = np.empty(objects, dtype=np.int64)
        who, where = np.empty(objects, dtype=np.int64), np.empty(objects, dtype=np.int64)
        sequence, depth = np.empty(objects, dtype=np.int64), np.empty(objects)
        before = np.empty(objects + 1, dtype=odds.dtype)
        for row in range(height):
            in_row = _in_row(bounds, origin, objects, row, here)
            for strip in range((width + 7) // 8 if in_row > 0 else 0):
                found = _in_strip(bounds, starts, origin, row, strip, here, in_row, who, where)
                lanes = min(8, width - strip * 8)
                if mode == ALONE or found == 1:
                    for i in range(found):
                        for lane in range(lanes):
                            j = where[i] + lane
                            packed[j] = upstream[image, who[i], row, strip * 8 + lane] / odds[j]
                    continue
                for lane in range(lanes if found > 0 else 0):
                    column = strip * 8 + lane
                    count = _sort(order, where, found, lane, sequence, depth)
                    before[0] = one
                    for place in range(count):
                        before[place + 1] = before[place] / odds[where[sequence[place]] + lane]
                    behind = zero if mode == LAYERED else one
                    for place in range(count - 1, -1, -1):
                        j = where[sequence[place]] + lane
                        missed = one / odds[j]
                        if mode == LAYERED:
                            above = upstream[image, who[sequence[place]], row, column]
                            packed[j] = before[place] * (above - behind) * missed
                            behind = above * (one - missed) + missed * behind
                        else:
                            # The front-most object's mask is 1 - prod missed of all objects.
                            above = upstream[image, who[sequence[0]], row, column]
                            packed[j] = above * before[place] * behind * missed
                            behind *= missed


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, pixels, depths, triangles, drawn, settings):
        points, z = (part.detach().flatten(0, 1).contiguous().numpy() for part in (pixels, depths))
        windows = windows_of(points, z, drawn.contiguous().flatten().numpy(), settings)
        arguments = (points, z, triangles.contiguous().numpy(), windows, settings)
        engine = outline if settings.mode == "fast" else faces
        odds, order, traced = engine.cover(*arguments)
        images, objects = pixels.shape[:2]
        visible = np.zeros((images, objects, *settings.image_size), dtype=odds.dtype)
        front = np.full((images, *settings.image_size), -1, dtype=np.int32)
        depth = np.full((images, *settings.image_size), np.inf, dtype=odds.dtype)
        mode = MODES.index(settings.compositing)
        in_threads(_compose, images, odds, order, *windows, mode, visible, front, depth)
        ctx.rest = (engine, arguments, odds, order, traced, mode)
        results = tuple(torch.from_numpy(array) for array in (visible, front, depth))
        ctx.mark_non_differentiable(*results[1:])
        return results

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream, _front, _depth):
        engine, arguments, odds, order, traced, mode = ctx.rest
        wanted, packed = upstream.contiguous().numpy(), np.zeros_like(odds)
        composed = (odds, order, *arguments[3], mode, wanted, packed)
        in_threads(_compose_backward, len(upstream), *composed)
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
