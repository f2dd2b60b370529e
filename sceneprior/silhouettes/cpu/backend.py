"""Projected meshes in, visible masks and their gradient out: the Numba backend's front door."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneprior.silhouettes.cpu import compositing, faces, outline
from sceneprior.silhouettes.cpu.windows import windows_of
from sceneprior.silhouettes.reference import Settings


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, pixels, depths, triangles, drawn, settings):
        shape = pixels.shape[:2]
        points = pixels.detach().flatten(0, 1).contiguous().numpy()
        z = depths.detach().flatten(0, 1).contiguous().numpy()
        triangles = triangles.contiguous().numpy()
        windows = windows_of(
            points,
            z,
            drawn.contiguous().flatten().numpy(),
            settings.image_size,
            float(np.sqrt(settings.blur_px2)),
            settings.near_m,
        )
        arguments = (points, z, triangles, windows, settings)
        engine = outline if settings.mode == "fast" else faces
        odds, order, traced = engine.cover(*arguments)
        size = (*shape, *settings.image_size)
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
        pull = upstream.contiguous().numpy()
        force = compositing.force_of(odds, order, windows, settings.compositing, pull)
        gradient = engine.pull_back(*arguments, odds, traced, force)
        gradient = gradient.reshape(*upstream.shape[:2], *gradient.shape[1:])
        return torch.from_numpy(gradient), None, None, None, None


def draw(
    pixels: Float[Tensor, "images objects vertices 2"],
    depths: Float[Tensor, "images objects vertices"],
    triangles: Int[Tensor, "faces 3"],
    drawn: Bool[Tensor, "images objects"],
    settings: Settings,
) -> tuple[
    Float[Tensor, "images objects height width"],
    Int[Tensor, "images height width"],
    Float[Tensor, "images height width"],
]:
    """Masks, front-most object and its depth: see `sceneprior.silhouettes.render`."""
    return _Draw.apply(pixels, depths, triangles.long(), drawn, settings)
