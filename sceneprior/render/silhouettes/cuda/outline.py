"""The fast mode on CUDA: each mesh's outline is extracted once, and only the outline is soft.

`cpu.outline` defines the result. Here, the candidate edges of all meshes are listed together and
cut into pieces, pieces with a face beyond them are discarded, and each tile iterates over the
pieces of its mesh. The host synchronises twice, for the numbers of edges and of pieces. Decisions
(areas, crossings, whether a pixel centre is inside) are computed in float64, at twice the cost of
float32 on an H200; distances near the image are in the precision of the input.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from sceneprior.render.silhouettes.cuda.faces import layers_of, sum_by_vertex
from sceneprior.render.silhouettes.cuda.kernels import (
    BLOCK,
    MIN_AREA,
    SLACK,
    TILE,
    Edges,
    Windows,
    bits_of,
    corners_of,
    first_bit,
    hits,
    launch,
    reach_of,
    tile_pixels,
    tl,
    triton,
    window,
)
from sceneprior.render.silhouettes.reference import ASIDE_PX, PIECE_PX, Settings

PIECES, LINES = tl.constexpr(16), tl.constexpr(32)
"""Pieces per program of `certify_pieces`, and edges processed at once for each."""

PER_PROGRAM, PIXELS = tl.constexpr(8), tl.constexpr(8)
"""Pieces per program of `end_gradients`, and pixels processed at once for each."""


@triton.jit
def _ends_of(lines, line, count, mask):  # pragma: no cover - compiled
    """x and y of both ends of lines, which are stored as four rows of `count` numbers."""
    x0 = tl.load(lines + line, mask=mask, other=0)
    y0 = tl.load(lines + count + line, mask=mask, other=0)
    x1 = tl.load(lines + 2 * count + line, mask=mask, other=0)
    return x0, y0, x1, tl.load(lines + 3 * count + line, mask=mask, other=0)


@triton.jit
def certify_pieces(
    points, piece_meshes, lines, layers, first_lines, clear, piece_count, line_count
):  # pragma: no cover - compiled
    """Set `clear` for points that no face covers: the layers of edges to the right sum to 0."""
    piece = tl.program_id(0) * PIECES + tl.arange(0, PIECES)[:, None]
    exists = piece < piece_count
    mesh = tl.load(piece_meshes + piece, mask=exists, other=0)
    first = tl.load(first_lines + mesh)
    last = tl.where(exists, tl.load(first_lines + mesh + 1), first)
    x = tl.load(points + piece, mask=exists, other=0)
    y = tl.load(points + piece_count + piece, mask=exists, other=0)
    over = tl.zeros((PIECES, LINES), tl.int32)
    most = tl.max(tl.max(last - first, axis=1), axis=0)
    for start in range(0, most, LINES):
        line = first + start + tl.arange(0, LINES)[None, :]
        here = line < last
        ax, ay, bx, by = _ends_of(lines, line, line_count, here)
        more = tl.load(layers + line, mask=here, other=0)
        down = by > ay
        # A ray to the right crosses an edge that runs down the image from its left side.
        beyond = ((y - ay) * (bx - ax) > (x - ax) * (by - ay)) == down
        crossed = here & ((ay <= y) != (by <= y)) & beyond
        over += tl.where(crossed, tl.where(down, more, -more), 0)
    piece = tl.program_id(0) * PIECES + tl.arange(0, PIECES)
    free = (tl.sum(over, axis=1) <= 0).to(tl.uint8)
    tl.store(clear + piece, free, mask=piece < piece_count)


@triton.jit
def _pieces_near(
    shapes, clear, first, last, piece_count, top_row, left_column, reach
):  # pragma: no cover - compiled
    """Bit mask: bit i is set if outline piece first + i may reach the tile with its blur."""
    lane = tl.arange(0, BLOCK)
    piece = first + lane
    known = piece < last
    x0, y0, x1, y1 = _ends_of(shapes, piece, piece_count, known)
    hit = known & (tl.load(clear + piece, mask=known, other=0) != 0)
    hit &= (tl.minimum(x0, x1) - reach < left_column + TILE) & (
        tl.maximum(x0, x1) + reach > left_column
    )
    hit &= (tl.minimum(y0, y1) - reach < top_row + TILE) & (tl.maximum(y0, y1) + reach > top_row)
    return bits_of(hit, lane)


@triton.jit
def _to_piece(px, py, x0, y0, x1, y1):  # pragma: no cover - compiled
    """Vector from the nearest point of a piece to p, and that point's parameter in [0, 1]."""
    ux, uy = x1 - x0, y1 - y0
    qx, qy = px - x0, py - y0
    s = (qx * ux + qy * uy) / tl.maximum(ux * ux + uy * uy, MIN_AREA)
    s = tl.minimum(tl.maximum(s, 0.0), 1.0)
    return qx - s * ux, qy - s * uy, s


@triton.jit
def trace_tiles(
    pixels, nearness, faces, face_bounds, block_bounds, windows, first_tiles, tile_meshes,
    shapes, clear, first_pieces, missed, order, nearest,
    vertex_count, block_count, piece_count, sigma, blur, reach,
):  # pragma: no cover - compiled  # fmt: skip
    """Draw one mesh in one tile: 1 - coverage, the order value and the nearest outline piece.

    `nearness` is 1 / depth in float64. The order value is defined in `cover_tiles`, with the
    outline's depth in the halo.
    """
    mesh, top_row, left_column, row, column, at = tile_pixels(windows, first_tiles, tile_meshes)
    px, py = column.to(tl.float64) + 0.5, row.to(tl.float64) + 0.5
    inverse_inside = tl.zeros((TILE * TILE,), tl.float64)  # 1 / depth; 0 is infinitely far
    row_size = block_count * BLOCK
    block_bounds += mesh * 4 * block_count
    face_bounds += mesh * 4 * row_size
    for group in range(0, block_count, BLOCK):
        blocks = hits(block_bounds, group, block_count, block_count, top_row, left_column)
        while blocks != 0:
            first = (group + first_bit(blocks)) * BLOCK
            blocks &= blocks - 1
            found = hits(face_bounds, first, row_size, row_size, top_row, left_column)
            while found != 0:
                face = first + first_bit(found)
                found &= found - 1
                a, b, c, ax, ay, bx, by, cx, cy = corners_of(
                    pixels, faces, face, mesh * vertex_count, True, tl.float64
                )
                ux, uy, vx, vy = bx - ax, by - ay, cx - ax, cy - ay
                qx, qy, over = px - ax, py - ay, 1.0 / (ux * vy - uy * vx)
                wb, wc = (qx * vy - qy * vx) * over, (qy * ux - qx * uy) * over
                inside = (wb > -SLACK) & (wc > -SLACK) & (wb + wc < 1.0 + SLACK)
                ia, ib, ic = tl.load(nearness + a), tl.load(nearness + b), tl.load(nearness + c)
                inverse = ia + wb * (ib - ia) + wc * (ic - ia)
                inverse_inside = tl.maximum(inverse_inside, tl.where(inside, inverse, 0.0))
    real = missed.dtype.element_ty
    px, py = column.to(real) + 0.5, row.to(real) + 0.5
    distance = tl.zeros((TILE * TILE,), real) + blur
    inverse_halo = tl.zeros((TILE * TILE,), real)
    who = tl.full((TILE * TILE,), -1, tl.int32)
    last = tl.load(first_pieces + mesh + 1)
    for start in range(tl.load(first_pieces + mesh), last, BLOCK):
        found = _pieces_near(shapes, clear, start, last, piece_count, top_row, left_column, reach)
        while found != 0:
            piece = start + first_bit(found)
            found &= found - 1
            x0, y0, x1, y1 = _ends_of(shapes, piece, piece_count, True)
            i0 = tl.load(shapes + 4 * piece_count + piece)
            i1 = tl.load(shapes + 5 * piece_count + piece)
            rx, ry, s = _to_piece(px, py, x0, y0, x1, y1)
            here = rx * rx + ry * ry
            nearer = here < distance
            distance = tl.where(nearer, here, distance)
            inverse_halo = tl.where(nearer, i0 + s * (i1 - i0), inverse_halo)
            who = tl.where(nearer, piece, who)
    inside = inverse_inside > 0
    x = tl.minimum(tl.where(inside, distance, -distance) / sigma, 80.0)
    soft = tl.where(who >= 0, 1.0 / (1.0 + tl.exp(x)), tl.where(inside, 0.0, 1.0))
    tl.store(missed + at, soft)
    # -1 / 0 is minus infinity at pixels that are neither inside nor in the halo.
    halo = -1.0 / inverse_halo
    tl.store(order + at, tl.where(inside, (1.0 / inverse_inside).to(real), halo))
    tl.store(nearest + at, who)


@triton.jit
def end_gradients(
    shapes, spans, piece_meshes, clear, windows, first_tiles, missed, order, nearest, upstream,
    by_end, piece_count, sigma, reach,
):  # pragma: no cover - compiled  # fmt: skip
    """Gradients of each piece's edge ends, summed over the pixels that its blur may reach.

    The pixels of a piece are split between lanes, whose sums are added at the end.
    """
    piece = tl.program_id(0) * PER_PROGRAM + tl.arange(0, PER_PROGRAM)[:, None]
    exists = piece < piece_count
    mesh = tl.load(piece_meshes + piece, mask=exists, other=0).to(tl.int64)
    x0, y0, x1, y1 = _ends_of(shapes, piece, piece_count, exists)
    t0 = tl.load(spans + piece, mask=exists, other=0)
    t1 = tl.load(spans + piece_count + piece, mask=exists, other=0)
    base, stride = window(windows, first_tiles, mesh)
    top, left = tl.load(windows + mesh * 4) * TILE, tl.load(windows + mesh * 4 + 1) * TILE
    bottom = top + tl.load(windows + mesh * 4 + 2) * TILE - 1
    right = left + stride - 1
    first_row = tl.maximum(tl.ceil(tl.minimum(y0, y1) - reach - 0.5).to(tl.int32), top)
    last_row = tl.minimum(tl.floor(tl.maximum(y0, y1) + reach - 0.5).to(tl.int32), bottom)
    first_column = tl.maximum(tl.ceil(tl.minimum(x0, x1) - reach - 0.5).to(tl.int32), left)
    last_column = tl.minimum(tl.floor(tl.maximum(x0, x1) + reach - 0.5).to(tl.int32), right)
    columns = tl.maximum(last_column - first_column + 1, 1)
    seen = (tl.load(clear + piece, mask=exists, other=0) != 0) & (last_row >= first_row)
    seen &= last_column >= first_column
    count = tl.where(seen, (last_row - first_row + 1) * columns, 0)
    most = tl.max(tl.max(count, axis=1), axis=0)
    real = by_end.dtype.element_ty
    gax, gay = tl.zeros((PER_PROGRAM, PIXELS), real), tl.zeros((PER_PROGRAM, PIXELS), real)
    gbx, gby = tl.zeros((PER_PROGRAM, PIXELS), real), tl.zeros((PER_PROGRAM, PIXELS), real)
    lane = tl.arange(0, PIXELS)[None, :]
    for start in range(0, most, PIXELS):
        place = start + lane
        row, column = first_row + place // columns, first_column + place % columns
        at = base + row * stride + column
        own = tl.load(nearest + at, mask=place < count, other=-1) == piece
        grad = tl.load(upstream + at, mask=own, other=0)
        if tl.max(tl.max(tl.abs(grad), axis=1), axis=0) > 0:
            px, py = column.to(real) + 0.5, row.to(real) + 0.5
            rx, ry, s = _to_piece(px, py, x0, y0, x1, y1)
            # Moving the nearest point of the outline changes the squared distance by -2 r.
            weight = -2.0 * grad * (1.0 - tl.load(missed + at, mask=own, other=1)) / sigma
            weight = tl.where(tl.load(order + at, mask=own, other=1) > 0, weight, -weight)
            share = t0 + s * (t1 - t0)
            gax += (1.0 - share) * weight * rx
            gay += (1.0 - share) * weight * ry
            gbx += share * weight * rx
            gby += share * weight * ry
    piece = tl.program_id(0) * PER_PROGRAM + tl.arange(0, PER_PROGRAM)
    exists = piece < piece_count
    to = by_end + piece.to(tl.int64) * 4
    tl.store(to, tl.sum(gax, axis=1), mask=exists)
    tl.store(to + 1, tl.sum(gay, axis=1), mask=exists)
    tl.store(to + 2, tl.sum(gbx, axis=1), mask=exists)
    tl.store(to + 3, tl.sum(gby, axis=1), mask=exists)


class _Pieces(NamedTuple):
    """Straight pieces of edges, sorted by mesh."""

    shapes: Tensor
    """(6, pieces): x and y of both ends in pixels, and 1 / depth at both."""

    spans: Tensor
    """(2, pieces): start and end on the edge, from 0 at its first vertex to 1 at its second."""

    vertices: Tensor
    """(pieces, 2): vertices of the edge, numbered across all meshes."""

    meshes: Tensor
    clear: Tensor
    """1 for pieces of the outline, which have no face beyond them, else 0."""


def cover(
    pixels: Tensor,
    depths: Tensor,
    faces: Tensor,
    windows: Windows,
    settings: Settings,
    edges: Edges,
) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """1 - coverage and the order value at all pixels of the windows, and the inputs saved for
    `cover_backward`."""
    meshes, vertices, tiles = len(windows.places), pixels.shape[2], len(windows.tile_meshes)
    layers = layers_of(pixels, depths, faces, windows, settings, edges)
    nearness = depths.double().reciprocal()
    pieces = _cut_edges(pixels, nearness, edges.ends, layers, settings)
    missed = pixels.new_empty(tiles * TILE.value**2)
    order = torch.empty_like(missed)
    nearest = torch.empty_like(missed, dtype=torch.int32)
    launch(
        trace_tiles, tiles, pixels, nearness, faces, *windows, pieces.shapes, pieces.clear,
        _firsts(pieces.meshes, meshes), missed, order, nearest, vertices,
        windows.block_bounds.shape[-1], len(pieces.meshes), settings.sigma_px2,
        settings.blur_px2, reach_of(settings), num_warps=1,
    )  # fmt: skip
    return missed, order, (nearest, *pieces)


def _cut_edges(
    pixels: Tensor, nearness: Tensor, ends: Tensor, layers: Tensor, settings: Settings
) -> _Pieces:
    """Pieces, near the image, of all edges across which the number of faces changes."""
    meshes, edges = layers.nonzero().unbind(dim=1)
    layers = layers[meshes, edges]
    vertices = ends.long()[edges] + (meshes * pixels.shape[2]).unsqueeze(1)
    start, end = pixels.reshape(-1, 2)[vertices].double().unbind(dim=1)
    line, spans = _cut_lines(start, end, settings)
    along, side = (end - start)[line], layers[line].sign()
    # Towards the side with fewer faces: the right side, (y, -x), for positive layers.
    aside = torch.stack([along[:, 1], -along[:, 0]], dim=1) * side.unsqueeze(1)
    aside *= ASIDE_PX / along.norm(dim=1, keepdim=True)
    beside = start[line] + spans.mean(dim=0).unsqueeze(1) * along + aside
    clear = torch.empty(len(line), dtype=torch.uint8, device=pixels.device)
    launch(
        certify_pieces, -(-len(line) // PIECES.value), beside.T.contiguous(),
        meshes[line].int(), torch.cat([start, end], dim=1).T.contiguous(), layers,
        _firsts(meshes, pixels.shape[0] * pixels.shape[1]), clear, len(line), len(start),
        num_warps=4,
    )  # fmt: skip
    near0, near1 = nearness.flatten()[vertices[line]].unbind(dim=1)
    shapes = [(start[line] + t.unsqueeze(1) * along).T for t in spans]
    shapes += [torch.stack([(1 - t) * near0 + t * near1 for t in spans])]
    shape, spans = torch.cat(shapes).to(pixels.dtype), spans.to(pixels.dtype).contiguous()
    return _Pieces(shape, spans, vertices[line], meshes[line].int(), clear)


def _cut_lines(start: Tensor, end: Tensor, settings: Settings) -> tuple[Tensor, Tensor]:
    """Line and span of each piece of at most PIECE_PX near the image."""
    along = end - start
    count = (along.norm(dim=1) / PIECE_PX).ceil()
    low, high, reach = torch.zeros_like(count), torch.ones_like(count), reach_of(settings)
    for axis, size in enumerate(reversed(settings.image_size)):
        # A line without extent along an axis divides by 0: infinities give the right result, and
        # NaN leaves the line out.
        t = torch.stack([-reach - start[:, axis], size + reach - start[:, axis]]) / along[:, axis]
        low, high = torch.maximum(low, t.amin(dim=0)), torch.minimum(high, t.amax(dim=0))
    near = low < high
    first = torch.where(near, (low * count).floor(), 0.0)
    number = (torch.where(near, (high * count).ceil(), 0.0) - first).long()
    last = number.cumsum(dim=0)
    every = torch.arange(len(number), device=number.device)
    line = every.repeat_interleave(number, output_size=int(last[-1]) if len(last) else 0)
    place = torch.arange(len(line), device=line.device) - (last - number)[line] + first[line]
    return line, torch.stack([place, place + 1]) / count[line]


def _firsts(meshes: Tensor, count: int) -> Tensor:
    """The first index of each mesh in a list sorted by mesh, and the length of the list."""
    every = torch.arange(count + 1, dtype=meshes.dtype, device=meshes.device)
    return torch.searchsorted(meshes.contiguous(), every).int()


def cover_backward(
    pixels: Tensor,
    seen: tuple[Tensor, Tensor],
    settings: Settings,
    missed: Tensor,
    order: Tensor,
    traced: list[Tensor],
    upstream: Tensor,
) -> Tensor:
    """dL/dpixels from -dL/dlog(missed); a pixel contributes to the ends of its nearest edge."""
    nearest, *rest = traced
    pieces = _Pieces(*rest)
    count = len(pieces.meshes)
    by_end = pixels.new_empty(count, 2, 2)
    launch(
        end_gradients, -(-count // PER_PROGRAM.value), pieces.shapes, pieces.spans,
        pieces.meshes, pieces.clear, *seen, missed, order, nearest, upstream, by_end, count,
        settings.sigma_px2, reach_of(settings), num_warps=1,
    )  # fmt: skip
    # All meshes are summed as one, since their vertices are numbered consecutively.
    everywhere = torch.ones(1, 4, dtype=torch.int32, device=pixels.device)
    return sum_by_vertex(by_end, pieces.vertices.flatten(), everywhere, pixels)
