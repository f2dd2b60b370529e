"""The Triton backend: visible masks of projected meshes, and their gradient.

Without a GPU, the kernels run on CPU tensors through Triton's interpreter (TRITON_INTERPRET=1
before Triton is first imported): correctly, but too slowly for anything but tests.

    windows      tiles of the image that each mesh may touch
    faces        exact mode: coverage and depth order in the windows, and the gradient
    outline      fast mode: coverage and depth order in the windows, and the gradient
    compositing  windows to images, and the gradient
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneprior.render.silhouettes.cuda import compositing, faces, kernels, outline
from sceneprior.render.silhouettes.cuda.windows import (
    INTERPRETED,
    find_windows,
    launch,
    tiles_across,
)
from sceneprior.render.silhouettes.reference import Drawing, Settings


def draw(
    pixels: Float[Tensor, "images objects vertices 2"],
    depths: Float[Tensor, "images objects vertices"],
    triangles: Int[Tensor, "faces 3"],
    drawn: Bool[Tensor, "images objects"],
    settings: Settings,
) -> Drawing:
    """Draw as `reference.draw` does, with Triton kernels.

    Apart from the masks, memory grows with the pixels in the objects' bounding boxes; every face of
    every mesh takes 8 bytes (14 while drawing in fast mode, 24 more for gradients in exact mode).
    The result is deterministic. Compiled kernels round the numbers of `settings` to float32,
    whatever the precision of `pixels`.
    """
    if not (pixels.is_cuda or INTERPRETED):
        raise ValueError(
            f"the backend `cuda` needs tensors on a CUDA device, but these are on "
            f"'{pixels.device}'; move them there or choose another backend"
        )
    if max(settings.image_size) > kernels.EMPTY.value:
        raise ValueError(
            f"image_size is {settings.image_size}; the backend `cuda` draws sides of at most "
            f"{kernels.EMPTY.value} pixels"
        )
    return Drawing(*_Draw.apply(pixels, depths, triangles, drawn, settings))


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, pixels, depths, triangles, drawn, settings):
        images, objects = depths.shape[:2]
        height, width = settings.image_size
        pixels, depths = pixels.contiguous(), depths.contiguous()
        edges = outline.edges_of(triangles) if settings.mode == "fast" else None
        triangles = triangles.to(torch.int32).contiguous()
        windows = find_windows(pixels, depths, triangles, drawn, settings)
        meshes = (pixels, depths, triangles, windows, settings)
        missed, order, traced = (
            faces.cover(*meshes) if edges is None else outline.cover(*meshes, edges)
        )
        masks = pixels.new_empty(images, objects, height, width)
        front = torch.empty(images, height, width, dtype=torch.int32, device=pixels.device)
        depth = pixels.new_empty(images, height, width)
        launch(
            compositing.composite_tiles, images * tiles_across(height) * tiles_across(width),
            missed, order, windows.places, windows.first_tiles, masks, front, depth, objects,
            height, width, MODE=settings.compositing, num_warps=1,
        )  # fmt: skip
        ctx.mark_non_differentiable(front, depth)
        ctx.settings = settings
        ctx.save_for_backward(
            pixels, triangles, windows.places, windows.first_tiles, missed, order,
            masks if settings.compositing == "layered" else None, *traced,
        )  # fmt: skip
        return masks, front, depth

    @staticmethod
    @once_differentiable
    def backward(ctx, upstream, _front, _depth):
        pixels, triangles, places, first_tiles, missed, order, masks, *traced = ctx.saved_tensors
        images, objects = pixels.shape[:2]
        height, width = ctx.settings.image_size
        upstream = upstream.contiguous()
        packed = torch.empty_like(missed)
        launch(
            compositing.composite_backward, images * tiles_across(height) * tiles_across(width),
            missed, order, places, first_tiles, upstream if masks is None else masks, upstream,
            packed, objects, height, width, MODE=ctx.settings.compositing, num_warps=1,
        )  # fmt: skip
        seen = (places, first_tiles)
        if ctx.settings.mode == "fast":
            gradient = outline.cover_backward(
                pixels, seen, ctx.settings, missed, order, traced, packed
            )
        else:
            gradient = faces.cover_backward(pixels, triangles, seen, ctx.settings, traced, packed)
        return gradient, None, None, None, None
