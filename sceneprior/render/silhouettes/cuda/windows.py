"""Windows, the tiles of the image that each mesh may touch, and the launch of kernels."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from sceneprior.render.silhouettes.cuda.kernels import (
    BLOCK,
    EMPTY,
    TILE,
    are_drawn,
    corners_of,
    tl,
    triton,
)
from sceneprior.render.silhouettes.reference import Settings

INTERPRETED = not isinstance(corners_of, triton.JITFunction)
"""True if Triton's interpreter runs the kernels, on tensors of any device."""

REACH_MARGIN_PX = 1e-3
"""Added to the blur radius, so that a face misses no pixel by rounding."""


@triton.jit
def _store4(to, row_size, first, second, third, fourth, mask):  # pragma: no cover - compiled
    tl.store(to, first.to(tl.int16), mask=mask)
    tl.store(to + row_size, second.to(tl.int16), mask=mask)
    tl.store(to + 2 * row_size, third.to(tl.int16), mask=mask)
    tl.store(to + 3 * row_size, fourth.to(tl.int16), mask=mask)


@triton.jit
def bound_faces(
    pixels, depths, faces, drawn, face_bounds, block_bounds, windows,
    vertex_count, face_count, block_count, height, width, reach, near, GROUP: tl.constexpr,
):  # pragma: no cover - compiled  # fmt: skip
    """First and last row and column that each face, block and mesh may touch."""
    mesh = tl.program_id(0).to(tl.int64)
    shown = tl.where(tl.load(drawn + mesh) != 0, face_count, 0)
    mesh_first_row, mesh_last_row = height, -1
    mesh_first_column, mesh_last_column = width, -1
    for group in range(0, block_count, GROUP):
        block = group + tl.arange(0, GROUP)
        face = block[:, None] * BLOCK + tl.arange(0, BLOCK)[None, :]
        exists = face < shown
        a, b, c, ax, ay, bx, by, cx, cy = corners_of(
            pixels, faces, face, mesh * vertex_count, exists, pixels.dtype.element_ty
        )
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        keep = are_drawn(depths, a, b, c, area, exists, near)
        low = tl.ceil(tl.minimum(tl.minimum(ay, by), cy) - reach - 0.5)
        high = tl.floor(tl.maximum(tl.maximum(ay, by), cy) + reach - 0.5)
        first_row = tl.minimum(tl.maximum(low, 0), height).to(tl.int32)
        last_row = tl.maximum(tl.minimum(high, height - 1), -1).to(tl.int32)
        low = tl.ceil(tl.minimum(tl.minimum(ax, bx), cx) - reach - 0.5)
        high = tl.floor(tl.maximum(tl.maximum(ax, bx), cx) + reach - 0.5)
        first_column = tl.minimum(tl.maximum(low, 0), width).to(tl.int32)
        last_column = tl.maximum(tl.minimum(high, width - 1), -1).to(tl.int32)
        keep &= (first_row <= last_row) & (first_column <= last_column)
        first_row = tl.where(keep, first_row, EMPTY)
        last_row = tl.where(keep, last_row, -1)
        first_column = tl.where(keep, first_column, EMPTY)
        last_column = tl.where(keep, last_column, -1)

        row_size = block_count * BLOCK
        to = face_bounds + mesh * 4 * row_size + face
        known = block[:, None] < block_count
        _store4(to, row_size, first_row, last_row, first_column, last_column, known)
        low_row, high_row = tl.min(first_row, axis=1), tl.max(last_row, axis=1)
        low_column, high_column = tl.min(first_column, axis=1), tl.max(last_column, axis=1)
        to = block_bounds + mesh * 4 * block_count + block
        known = block < block_count
        _store4(to, block_count, low_row, high_row, low_column, high_column, known)
        mesh_first_row = tl.minimum(mesh_first_row, tl.min(low_row, axis=0))
        mesh_last_row = tl.maximum(mesh_last_row, tl.max(high_row, axis=0))
        mesh_first_column = tl.minimum(mesh_first_column, tl.min(low_column, axis=0))
        mesh_last_column = tl.maximum(mesh_last_column, tl.max(high_column, axis=0))
    top, left = mesh_first_row // TILE, mesh_first_column // TILE
    seen = mesh_last_row >= 0
    tl.store(windows + mesh * 4, top)
    tl.store(windows + mesh * 4 + 1, left)
    tl.store(windows + mesh * 4 + 2, tl.where(seen, mesh_last_row // TILE - top + 1, 0))
    tl.store(windows + mesh * 4 + 3, tl.where(seen, mesh_last_column // TILE - left + 1, 0))


class Windows(NamedTuple):
    """The parts of the images that the meshes may touch; see kernels.py."""

    face_bounds: Tensor
    block_bounds: Tensor
    places: Tensor
    """Top, left, rows and columns of each mesh, in tiles."""

    first_tiles: Tensor
    """Number of packed tiles before those of each mesh."""

    tile_meshes: Tensor
    """Mesh of each packed tile."""


def reach_of(settings: Settings) -> float:
    """Blur radius of a face or an outline in pixels, rounded up by a margin."""
    return settings.blur_px2**0.5 + REACH_MARGIN_PX


def tiles_across(pixels: int) -> int:
    return -(-pixels // TILE.value)


def find_windows(
    pixels: Tensor, depths: Tensor, faces: Tensor, drawn: Tensor, settings: Settings
) -> Windows:
    """Windows of all meshes. Synchronises with the device to read the number of tiles."""
    meshes = (pixels, depths, faces, drawn.to(torch.uint8).contiguous(), settings)
    face_bounds, block_bounds, places = _bound(*meshes, reach_of(settings))
    if settings.mode == "fast":
        # The window includes the blur, but faces are rasterised hard, with separate bounds.
        face_bounds, block_bounds, _ = _bound(*meshes, REACH_MARGIN_PX)
    counts = places[:, 2].long() * places[:, 3]
    ends = counts.cumsum(dim=0)
    every = torch.arange(len(counts), dtype=torch.int32, device=pixels.device)
    tile_meshes = every.repeat_interleave(counts, output_size=int(ends[-1]) if len(ends) else 0)
    return Windows(face_bounds, block_bounds, places, ends - counts, tile_meshes)


def _bound(
    pixels: Tensor, depths: Tensor, faces: Tensor, drawn: Tensor, settings: Settings, reach: float
) -> tuple[Tensor, Tensor, Tensor]:
    images, objects, vertices = depths.shape
    meshes, blocks = images * objects, -(-len(faces) // BLOCK.value)
    bounds = torch.empty((meshes, 4, blocks * BLOCK.value), dtype=torch.int16, device=pixels.device)
    block_bounds = torch.empty((meshes, 4, blocks), dtype=torch.int16, device=pixels.device)
    places = torch.empty((meshes, 4), dtype=torch.int32, device=pixels.device)
    # Fused multiply-adds are off: their rounding would give degenerate faces an area.
    launch(
        bound_faces, meshes, pixels, depths, faces, drawn, bounds, block_bounds,
        places, vertices, len(faces), blocks, *settings.image_size, reach, settings.near_m,
        GROUP=8, num_warps=4, enable_fp_fusion=False,
    )  # fmt: skip
    return bounds, block_bounds, places


def launch(kernel: Any, programs: int, first: Tensor, *arguments: Any, **options: Any) -> None:
    """Run a kernel on the device of its first argument."""
    # Stated explicitly, since Triton 3.10 changes the default; callers may turn it off.
    options = {"enable_fp_fusion": True} | options
    if programs > 0:
        with torch.cuda.device_of(first):
            kernel[(programs,)](first, *arguments, **options)
