"""Windows: the tiles of the image that each mesh may touch; and how kernels are launched."""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from sceneprior.silhouettes.cuda import kernels
from sceneprior.silhouettes.cuda.window_kernels import bound_faces
from sceneprior.silhouettes.reference import Settings

TILE = kernels.TILE.value
BLOCK = kernels.BLOCK.value
INTERPRETED = not isinstance(kernels.cover_tiles, kernels.triton.JITFunction)
"""Whether Triton's interpreter runs the kernels, on tensors anywhere."""

REACH_MARGIN_PX = 1e-3
"""Added to the reach of a blur, so that rounding of the corners hides no pixel from a face."""


class Windows(NamedTuple):
    """The parts of the images that the meshes may touch; see `kernels`."""

    face_bounds: Tensor
    block_bounds: Tensor
    places: Tensor
    """Top, left, rows and columns of each mesh, in tiles."""

    first_tiles: Tensor
    """Packed tiles before each mesh."""

    tile_meshes: Tensor
    """Mesh of each packed tile."""


def reach_of(settings: Settings) -> float:
    """How far a face or an outline blurs, a little more rather than less."""
    return settings.blur_px2**0.5 + REACH_MARGIN_PX


def tiles_across(pixels: int) -> int:
    return -(-pixels // TILE)


def find_windows(
    pixels: Tensor, depths: Tensor, faces: Tensor, drawn: Tensor, settings: Settings
) -> Windows:
    """Windows of all meshes. Waits for the device, for the number of tiles."""
    drawn = drawn.to(torch.uint8).contiguous()
    face_bounds, block_bounds, places = _bound(
        pixels, depths, faces, drawn, settings, reach_of(settings)
    )
    if settings.mode == "fast":
        # The window is as wide as the blur reaches, but faces are drawn hard.
        face_bounds, block_bounds, _ = _bound(
            pixels, depths, faces, drawn, settings, REACH_MARGIN_PX
        )
    counts = places[:, 2].long() * places[:, 3]
    ends = counts.cumsum(dim=0)
    meshes = torch.arange(len(counts), dtype=torch.int32, device=pixels.device)
    tile_meshes = meshes.repeat_interleave(counts, output_size=int(ends[-1]) if len(ends) else 0)
    return Windows(face_bounds, block_bounds, places, ends - counts, tile_meshes)


def _bound(
    pixels: Tensor, depths: Tensor, faces: Tensor, drawn: Tensor, settings: Settings, reach: float
) -> tuple[Tensor, Tensor, Tensor]:
    images, objects, vertices = depths.shape
    meshes, blocks = images * objects, -(-len(faces) // BLOCK)
    bounds = torch.empty((meshes, 4, blocks * BLOCK), dtype=torch.int16, device=pixels.device)
    block_bounds = torch.empty((meshes, 4, blocks), dtype=torch.int16, device=pixels.device)
    places = torch.empty((meshes, 4), dtype=torch.int32, device=pixels.device)
    # Without fused multiply-adds, whose rounding would lend an area to a face that has none.
    launch(
        bound_faces, meshes, pixels, depths, faces, drawn, bounds, block_bounds,
        places, vertices, len(faces), blocks, *settings.image_size, reach, settings.near_m,
        GROUP=8, num_warps=4, enable_fp_fusion=False,
    )  # fmt: skip
    return bounds, block_bounds, places


def launch(kernel: Any, programs: int, first: Tensor, *arguments: Any, **options: Any) -> None:
    """Run a kernel on the device of its first argument."""
    # Said aloud, since Triton 3.10 turns its default round. Those who need it off say so.
    options = {"enable_fp_fusion": True} | options
    if programs > 0:
        with torch.cuda.device_of(first):
            kernel[(programs,)](first, *arguments, **options)
