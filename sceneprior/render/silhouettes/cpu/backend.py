"""The Numba backend: visible masks of projected meshes, and their gradient."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneprior.render.silhouettes.cpu import compositing, faces, outline
from sceneprior.render.silhouettes.cpu.windows import windows_of
from sceneprior.render.silhouettes.reference import Drawing, Settings


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
