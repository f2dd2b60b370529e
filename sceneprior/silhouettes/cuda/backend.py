"""Projected meshes in, visible masks and their gradient out: the Triton backend's front door.

Where no GPU is at hand, the kernels run on CPU tensors through Triton's interpreter
(TRITON_INTERPRET=1 before Triton is first imported): right, and far too slow for more than a test.

    cuda_windows      where each mesh may touch the image, in tiles
    cuda_faces        exact mode: what each pixel of the windows sees of its mesh, and back
    cuda_outline      fast mode: the same
    cuda_compositing  windows to images, and back
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneprior.silhouettes.cuda import compositing as cuda_compositing
from sceneprior.silhouettes.cuda import faces as cuda_faces
from sceneprior.silhouettes.cuda import kernels as cuda_kernels
from sceneprior.silhouettes.cuda import outline as cuda_outline
from sceneprior.silhouettes.cuda.windows import INTERPRETED, find_windows, launch, tiles_across
from sceneprior.silhouettes.reference import Settings


def draw(
    pixels: Float[Tensor, "images objects vertices 2"],
    depths: Float[Tensor, "images objects vertices"],
    faces: Int[Tensor, "faces 3"],
    drawn: Bool[Tensor, "images objects"],
    settings: Settings,
) -> tuple[
    Float[Tensor, "images objects height width"],
    Int[Tensor, "images height width"],
    Float[Tensor, "images height width"],
]:
    """Masks, front-most object and its depth: see `sceneprior.silhouettes.render`.

    Beside the masks, memory grows with the pixels that the objects' bounding boxes cover; every
    face of every mesh keeps 8 bytes (14 while drawing in fast mode; 24 more while gradients are
    summed in exact mode). The same input gives the same bits. Compiled, the kernels round the
    numbers of `settings` to float32, whatever the precision of `pixels`.

    Raises:
        ValueError: tensors that are not on a CUDA device, or an image with a side of more than
            32,767 pixels.
    """
    if not (pixels.is_cuda or INTERPRETED):
        raise ValueError(
            f"the backend `cuda` needs tensors on a CUDA device, but these are on "
            f"'{pixels.device}'; move them there or choose another backend"
        )
    if max(settings.image_size) > cuda_kernels.EMPTY.value:
        raise ValueError(
            f"image_size is {settings.image_size}; the backend `cuda` draws sides of at most "
            f"{cuda_kernels.EMPTY.value} pixels"
        )
    return _Draw.apply(pixels, depths, faces, drawn, settings)


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, pixels, depths, faces, drawn, settings):
        images, objects = depths.shape[:2]
        height, width = settings.image_size
        pixels, depths = pixels.contiguous(), depths.contiguous()
        triangles = faces.to(torch.int32).contiguous()
        windows = find_windows(pixels, depths, triangles, drawn, settings)
        if settings.mode == "fast":
            mesh = cuda_outline.edges_of(faces)
            missed, order, traced = cuda_outline.cover(
                pixels, depths, triangles, mesh, windows, settings
            )
        else:
            missed, order, traced = cuda_faces.cover(pixels, depths, triangles, windows, settings)
        masks = pixels.new_empty(images, objects, height, width)
        front = torch.empty(images, height, width, dtype=torch.int32, device=pixels.device)
        depth = pixels.new_empty(images, height, width)
        launch(
            cuda_compositing.composite_tiles, images * tiles_across(height) * tiles_across(width),
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
        pull = torch.empty_like(missed)
        launch(
            cuda_compositing.pull_tiles, images * tiles_across(height) * tiles_across(width),
            missed, order, places, first_tiles, upstream if masks is None else masks, upstream,
            pull, objects, height, width, MODE=ctx.settings.compositing, num_warps=1,
        )  # fmt: skip
        seen = (places, first_tiles)
        if ctx.settings.mode == "fast":
            gradient = cuda_outline.pull_back(
                pixels, seen, ctx.settings, missed, order, traced, pull
            )
        else:
            gradient = cuda_faces.pull_back(pixels, triangles, seen, ctx.settings, traced, pull)
        return gradient, None, None, None, None
