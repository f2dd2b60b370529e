"""Shared helpers of the Triton kernels, their launch, and the windows of the meshes.

A mesh is one object in one image. Its window is the part of the image that its faces may touch, in
whole tiles of TILE x TILE pixels. Windows are packed one after the other, row by row, so memory
grows with the covered pixels. No two programs add to the same address, so results are
deterministic. `missed` is 1 - coverage, the probability that the mesh misses the pixel.

    kernels  bound_faces         per mesh          pixels that faces touch, and the window
    faces    cover_tiles         per packed tile   missed, order value
             corner_gradients    per few faces     gradient of each face's corners
             gather_vertices     per few vertices  gradient of each vertex
             sum_layers          per few edges     change in the number of faces
    outline  certify_pieces      per few pieces    pieces without a face beyond them
             trace_tiles         per packed tile   missed, order value, nearest piece
             end_gradients       per few pieces    gradient of the edge's ends
    backend  composite_tiles     per image tile    masks, front, depth
             composite_backward  per image tile    gradient of packed pixels

`faces` implements the exact mode, `outline` the fast mode. Block shapes are chosen for an H200 by
counting instructions and registers, not yet by measurement.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

try:
    import triton
    import triton.language as tl
except ImportError as error:
    raise ImportError(
        "the silhouettes' backend `cuda` needs Triton, which PyTorch's CUDA builds bring along; "
        "install it (pip install triton), choose the backend `reference`, or move the tensors to "
        "the CPU"
    ) from error

from sceneprior.render.silhouettes import reference
from sceneprior.render.silhouettes.reference import Settings, topology_of

TILE = tl.constexpr(8)
"""Side of a tile in pixels; its 64 pixels are 2 for each lane of a warp."""

BLOCK = tl.constexpr(32)
"""Faces tested at once; the hits are the bits of a 32-bit word. Consecutive faces of an icosphere
are close to each other, so that most tiles skip most blocks."""

EMPTY = tl.constexpr(32767)
"""First row and column of faces that touch no pixel, and the longest image side (int16)."""

MIN_AREA, SLACK = tl.constexpr(reference.MIN_AREA_PX2), tl.constexpr(reference.SLACK)


@triton.jit
def corners_of(
    pixels, faces, face, first_vertex, mask, real: tl.constexpr
):  # pragma: no cover - compiled
    """The three vertices of each face, numbered across all meshes, and their u and v."""
    a = first_vertex + tl.load(faces + face * 3, mask=mask, other=0)
    b = first_vertex + tl.load(faces + face * 3 + 1, mask=mask, other=0)
    c = first_vertex + tl.load(faces + face * 3 + 2, mask=mask, other=0)
    ax = tl.load(pixels + a * 2, mask=mask, other=0).to(real)
    ay = tl.load(pixels + a * 2 + 1, mask=mask, other=0).to(real)
    bx = tl.load(pixels + b * 2, mask=mask, other=0).to(real)
    by = tl.load(pixels + b * 2 + 1, mask=mask, other=0).to(real)
    cx = tl.load(pixels + c * 2, mask=mask, other=0).to(real)
    cy = tl.load(pixels + c * 2 + 1, mask=mask, other=0).to(real)
    return a, b, c, ax, ay, bx, by, cx, cy


@triton.jit
def are_drawn(depths, a, b, c, area, mask, near):  # pragma: no cover - compiled
    """True for faces that lie in front of the near plane and are not degenerate."""
    za, zb = tl.load(depths + a, mask=mask, other=0), tl.load(depths + b, mask=mask, other=0)
    nearest = tl.minimum(tl.minimum(za, zb), tl.load(depths + c, mask=mask, other=0))
    return mask & (nearest > near) & (tl.abs(area) > MIN_AREA)


@triton.jit
def window(windows, first_tiles, mesh):  # pragma: no cover - compiled
    """(base, stride): pixel (row, column) of a mesh is packed at base + row * stride + column."""
    top, left = tl.load(windows + mesh * 4), tl.load(windows + mesh * 4 + 1)
    stride = tl.load(windows + mesh * 4 + 3) * TILE
    base = tl.load(first_tiles + mesh) * (TILE * TILE) - top * TILE * stride - left * TILE
    return base, stride


@triton.jit
def packed_at(windows, first_tiles, mesh, row, column):  # pragma: no cover - compiled
    """Packed indices of a mesh's pixels."""
    base, stride = window(windows, first_tiles, mesh)
    return base + row * stride + column


@triton.jit
def bits_of(hit, lane):  # pragma: no cover - compiled
    """BLOCK booleans as the bits of one word."""
    bit = tl.full((BLOCK,), 1, tl.uint32) << lane.to(tl.uint32)
    return tl.sum(tl.where(hit, bit, 0), axis=0).to(tl.uint32)


@triton.jit
def tile_pixels(windows, first_tiles, tile_meshes):  # pragma: no cover - compiled
    """Mesh, top row and left column of this program's tile; rows, columns and packed indices of the
    tile's pixels."""
    tile = tl.program_id(0).to(tl.int64)
    mesh = tl.load(tile_meshes + tile).to(tl.int64)
    base, stride = window(windows, first_tiles, mesh)
    columns = stride // TILE
    place = (tile - tl.load(first_tiles + mesh)).to(tl.int32)
    top_row = (tl.load(windows + mesh * 4) + place // columns) * TILE
    left_column = (tl.load(windows + mesh * 4 + 1) + place % columns) * TILE
    pixel = tl.arange(0, TILE * TILE)
    row, column = top_row + pixel // TILE, left_column + pixel % TILE
    return mesh, top_row, left_column, row, column, base + row * stride + column


@triton.jit
def holds(windows, mesh, tile_row, tile_column):  # pragma: no cover - compiled
    """True if an image tile lies in the mesh's window."""
    top, left = tl.load(windows + mesh * 4), tl.load(windows + mesh * 4 + 1)
    rows, columns = tl.load(windows + mesh * 4 + 2), tl.load(windows + mesh * 4 + 3)
    below = (tile_row >= top) & (tile_row < top + rows)
    return below & (tile_column >= left) & (tile_column < left + columns)


@triton.jit
def hits(bounds, first, count, row_size, row, column):  # pragma: no cover - compiled
    """Bit mask: bit i is set if entry first + i of the bounds meets the tile at (row, column)."""
    lane = tl.arange(0, BLOCK)
    at = bounds + first + lane
    known = first + lane < count
    hit = known & (tl.load(at, mask=known, other=EMPTY) < row + TILE)
    hit &= tl.load(at + row_size, mask=known, other=-1) >= row
    hit &= tl.load(at + 2 * row_size, mask=known, other=EMPTY) < column + TILE
    hit &= tl.load(at + 3 * row_size, mask=known, other=-1) >= column
    return bits_of(hit, lane)


@triton.jit
def first_bit(bits):  # pragma: no cover - compiled
    """Index of the lowest set bit, read from the exponent of its float32 value."""
    lowest = bits ^ (bits & (bits - 1))
    return (lowest.to(tl.float32).to(tl.int32, bitcast=True) >> 23) - 127


@triton.jit
def to_edge(px, py, ax, ay, bx, by):  # pragma: no cover - compiled
    """Vector to p from the nearest point of edge ab, that point's parameter on ab, and twice the
    signed area of triangle (p, a, b)."""
    ex, ey = bx - ax, by - ay
    qx, qy = px - ax, py - ay
    t = (qx * ex + qy * ey) * (1.0 / tl.maximum(ex * ex + ey * ey, MIN_AREA))
    t = tl.minimum(tl.maximum(t, 0.0), 1.0)
    return qx - t * ex, qy - t * ey, t, ex * qy - ey * qx


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
    """The parts of the images that the meshes may touch."""

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


class Edges(NamedTuple):
    """Edges of a mesh; the faces at edge e are faces[first_faces[e] : first_faces[e + 1]]."""

    ends: Tensor
    """(edges, 2) vertices, the lower first."""

    first_faces: Tensor
    faces: Tensor
    ways: Tensor
    """+1 if the face traverses the edge from its first to its second vertex, else -1."""


_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()


def edges_of(faces: Tensor) -> Edges:
    """Edges of a mesh, on its device; cached until `faces` is modified."""
    if faces.is_inference():  # an inference tensor has no version counter
        return _read_edges(faces)
    version, edges = _known.get(faces, (None, None))
    if version != faces._version:
        version, edges = faces._version, _read_edges(faces)
        _known[faces] = version, edges
    return edges


def _read_edges(faces: Tensor) -> Edges:
    ends, edge_of, way = (torch.from_numpy(part) for part in topology_of(faces.cpu().numpy()))
    owners, places = edge_of.flatten().sort(stable=True)
    first = torch.searchsorted(owners, torch.arange(len(ends) + 1, dtype=owners.dtype))
    parts = (ends, first, places // 3, way.flatten()[places])
    return Edges(*(part.int().to(faces.device) for part in parts))


def launch(kernel: Any, programs: int, first: Tensor, *arguments: Any, **options: Any) -> None:
    """Run a kernel on the device of its first argument."""
    # Stated explicitly, since Triton 3.10 changes the default; callers may turn it off.
    options = {"enable_fp_fusion": True} | options
    if programs > 0:
        with torch.cuda.device_of(first):
            kernel[(programs,)](first, *arguments, **options)
