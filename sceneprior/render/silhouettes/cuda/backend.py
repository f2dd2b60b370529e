"""The Triton backend: visible masks of projected meshes, and their gradient.

Without a GPU, the kernels run on CPU tensors through Triton's interpreter (TRITON_INTERPRET=1
before Triton is first imported): correctly, but too slowly for anything but tests.

    kernels  tiles of the image that each mesh may touch
    faces    exact mode: coverage and depth order in the windows, and the gradient
    outline  fast mode: coverage and depth order in the windows, and the gradient
    here     windows to images, and the gradient

For the composition there is one program per image tile. Few objects meet in a tile, so all pairs
are compared instead of sorting. `missed` and `order` are the outputs of `cover_tiles` or
`trace_tiles`.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from sceneprior.render.silhouettes.cuda import faces, outline
from sceneprior.render.silhouettes.cuda.kernels import (
    EMPTY,
    INTERPRETED,
    TILE,
    edges_of,
    find_windows,
    holds,
    launch,
    packed_at,
    tiles_across,
    tl,
    triton,
)
from sceneprior.render.silhouettes.reference import Drawing, Settings

CERTAIN = tl.constexpr(1.5e-8)
"""Value of 1 - coverage up to which a pixel gets no gradient; 1 - 1.5e-8 rounds to 1 in float32."""


@triton.jit
def _tile_pixels(height, width):  # pragma: no cover - compiled
    """Image, tile and pixels of this program."""
    columns = tl.cdiv(width, TILE)
    tiles = tl.cdiv(height, TILE) * columns
    image = tl.program_id(0).to(tl.int64) // tiles
    tile = tl.program_id(0) % tiles
    tile_row, tile_column = tile // columns, tile % columns
    pixel = tl.arange(0, TILE * TILE)
    row, column = tile_row * TILE + pixel // TILE, tile_column * TILE + pixel % TILE
    return image, tile_row, tile_column, row, column


@triton.jit
def _missed_before(
    missed, order, windows, first_tiles, mesh, objects, k, z, tile_row, tile_column, row, column
):  # pragma: no cover - compiled  # fmt: skip
    """Product of 1 - coverage over the objects nearer than k; at equal depth, lower ids are
    nearer."""
    before = tl.full((TILE * TILE,), 1, missed.dtype.element_ty)
    for other in range(0, objects):
        if (other != k) & holds(windows, mesh - k + other, tile_row, tile_column):
            at = packed_at(windows, first_tiles, mesh - k + other, row, column)
            there = tl.abs(tl.load(order + at))
            nearer = (there < z) | ((there == z) & (other < k))
            before *= tl.where(nearer, tl.load(missed + at), 1.0)
    return before


@triton.jit
def composite_tiles(
    missed, order, windows, first_tiles, masks, front, depth, objects, height, width,
    MODE: tl.constexpr,
):  # pragma: no cover - compiled  # fmt: skip
    """Masks of all objects, and the id and depth of the nearest surface."""
    image, tile_row, tile_column, row, column = _tile_pixels(height, width)
    real = missed.dtype.element_ty
    surface = tl.full((TILE * TILE,), float("inf"), real)
    surface_id = tl.full((TILE * TILE,), -1, tl.int32)
    nearest = tl.full((TILE * TILE,), float("inf"), real)
    nearest_id = tl.full((TILE * TILE,), -1, tl.int32)
    nothing = tl.full((TILE * TILE,), 1, real)
    for k in range(0, objects):
        mesh = image * objects + k
        if holds(windows, mesh, tile_row, tile_column):
            at = packed_at(windows, first_tiles, mesh, row, column)
            z = tl.load(order + at)
            nearer = (z > 0) & (z < surface)
            surface, surface_id = tl.where(nearer, z, surface), tl.where(nearer, k, surface_id)
            nearer = tl.abs(z) < nearest
            nearest = tl.where(nearer, tl.abs(z), nearest)
            nearest_id = tl.where(nearer, k, nearest_id)
            nothing *= tl.load(missed + at)
    real_pixel = (row < height) & (column < width)
    to = (image * height + row) * width + column
    tl.store(front + to, surface_id, mask=real_pixel)
    tl.store(depth + to, surface, mask=real_pixel)
    for k in range(0, objects):
        mesh = image * objects + k
        mask = tl.zeros((TILE * TILE,), real)
        if holds(windows, mesh, tile_row, tile_column):
            at = packed_at(windows, first_tiles, mesh, row, column)
            if MODE == "paper":
                mask = tl.where(nearest_id == k, 1.0 - nothing, 0.0)
            else:
                mask = 1.0 - tl.load(missed + at)
                if MODE == "layered":
                    z = tl.abs(tl.load(order + at))
                    mask *= _missed_before(
                        missed, order, windows, first_tiles, mesh, objects, k, z,
                        tile_row, tile_column, row, column,
                    )  # fmt: skip
        tl.store(masks + (mesh * height + row) * width + column, mask, mask=real_pixel)


@triton.jit
def composite_backward(
    missed, order, windows, first_tiles, masks, upstream, packed, objects, height, width,
    MODE: tl.constexpr,
):  # pragma: no cover - compiled  # fmt: skip
    """Store -dL/dlog(missed) in `packed`; dL/dmissed would divide by 0 at fully covered pixels.

    In the mode `layered`, dmask_k/dlog(missed_k) is -missed_k times the product of `missed` over
    nearer objects, and each mask behind k is proportional to missed_k.
    """
    image, tile_row, tile_column, row, column = _tile_pixels(height, width)
    real = missed.dtype.element_ty
    real_pixel = (row < height) & (column < width)
    nearest = tl.full((TILE * TILE,), float("inf"), real)
    shared = tl.zeros((TILE * TILE,), real)
    if MODE == "paper":
        nothing = tl.full((TILE * TILE,), 1, real)
        for k in range(0, objects):
            mesh = image * objects + k
            if holds(windows, mesh, tile_row, tile_column):
                at = packed_at(windows, first_tiles, mesh, row, column)
                z = tl.abs(tl.load(order + at))
                wanted = tl.load(
                    upstream + (mesh * height + row) * width + column, mask=real_pixel, other=0
                )
                shared = tl.where(z < nearest, wanted, shared)
                nearest = tl.minimum(nearest, z)
                nothing *= tl.load(missed + at)
        shared *= nothing
    for k in range(0, objects):
        mesh = image * objects + k
        if holds(windows, mesh, tile_row, tile_column):
            at = packed_at(windows, first_tiles, mesh, row, column)
            own = tl.load(missed + at)
            grad = shared
            if MODE != "paper":
                wanted = tl.load(
                    upstream + (mesh * height + row) * width + column, mask=real_pixel, other=0
                )
                grad = wanted * own
            if MODE == "layered":
                z = tl.abs(tl.load(order + at))
                grad *= _missed_before(
                    missed, order, windows, first_tiles, mesh, objects, k, z,
                    tile_row, tile_column, row, column,
                )  # fmt: skip
                for other in range(0, objects):
                    if (other != k) & holds(windows, mesh - k + other, tile_row, tile_column):
                        there = packed_at(windows, first_tiles, mesh - k + other, row, column)
                        there = tl.abs(tl.load(order + there))
                        behind = real_pixel & ((there > z) | ((there == z) & (other > k)))
                        to = ((mesh - k + other) * height + row) * width + column
                        grad -= tl.load(masks + to, mask=behind, other=0) * tl.load(
                            upstream + to, mask=behind, other=0
                        )
            tl.store(packed + at, tl.where(own > CERTAIN, grad, 0.0))


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
    if max(settings.image_size) > EMPTY.value:
        raise ValueError(
            f"image_size is {settings.image_size}; the backend `cuda` draws sides of at most "
            f"{EMPTY.value} pixels"
        )
    return Drawing(*_Draw.apply(pixels, depths, triangles, drawn, settings))


class _Draw(torch.autograd.Function):
    @staticmethod
    def forward(ctx, pixels, depths, triangles, drawn, settings):
        images, objects = depths.shape[:2]
        height, width = settings.image_size
        pixels, depths = pixels.contiguous(), depths.contiguous()
        edges = edges_of(triangles) if settings.mode == "fast" else None
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
            composite_tiles, images * tiles_across(height) * tiles_across(width),
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
            composite_backward, images * tiles_across(height) * tiles_across(width),
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
