"""The exact mode on CUDA: launches of its kernels."""

import torch
from torch import Tensor

from sceneprior.silhouettes.cuda import gradients, kernels
from sceneprior.silhouettes.cuda.windows import BLOCK, TILE, Windows, launch
from sceneprior.silhouettes.reference import Settings

FACES, PIXELS = 8, 8
"""Faces of one backward program, and pixels of each that it takes at once. More faces need
more registers (about 100 for 8, 190 for 16); more pixels idle where faces are small."""

VERTICES = 128
"""Vertices of one program that sums gradients."""


def cover(
    pixels: Tensor, depths: Tensor, faces: Tensor, windows: Windows, settings: Settings
) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """The chance to miss and the order value of all windows, and what `cover_backward` needs."""
    tiles = len(windows.tile_meshes)
    missed = pixels.new_empty(tiles * TILE * TILE)
    order = torch.empty_like(missed)
    launch(
        kernels.cover_tiles, tiles, pixels, depths.reciprocal(), faces, windows.face_bounds,
        windows.block_bounds, windows.places, windows.first_tiles, windows.tile_meshes, missed,
        order, pixels.shape[2], windows.block_bounds.shape[-1], settings.sigma_px2,
        settings.blur_px2, num_warps=1,
    )  # fmt: skip
    return missed, order, (windows.face_bounds,)


def cover_backward(
    pixels: Tensor,
    faces: Tensor,
    seen: tuple[Tensor, Tensor],
    settings: Settings,
    traced: list[Tensor],
    upstream: Tensor,
) -> Tensor:
    """dL/dpixels from -dL/dlog(missed)."""
    (face_bounds,), (places, first_tiles) = traced, seen
    images, objects, vertices, _ = pixels.shape
    by_corner = pixels.new_empty(images * objects, len(faces), 3, 2)
    launch(
        gradients.corner_gradients, images * objects * -(-len(faces) // FACES), pixels, faces,
        face_bounds, places, first_tiles, upstream, by_corner, vertices, len(faces),
        face_bounds.shape[-1] // BLOCK, settings.sigma_px2, settings.blur_px2, FACES=FACES,
        PIXELS=PIXELS, num_warps=1,
    )  # fmt: skip
    return sum_by_vertex(by_corner, faces.flatten(), places, pixels)


def sum_by_vertex(by_corner: Tensor, owners: Tensor, places: Tensor, pixels: Tensor) -> Tensor:
    """Sum the gradients of each mesh's corners by their owners, the vertices; a row of `places` a
    mesh."""
    gradient = torch.empty_like(pixels)
    vertices = pixels.numel() // 2 // max(len(places), 1)
    owners, corners = owners.sort(stable=True)
    every = torch.arange(vertices + 1, dtype=owners.dtype, device=owners.device)
    launch(
        gradients.gather_vertices, len(places) * -(-vertices // VERTICES), by_corner, corners,
        torch.searchsorted(owners, every), places, gradient, vertices, len(corners),
        VERTICES=VERTICES, num_warps=4,
    )  # fmt: skip
    return gradient
