"""Shared helpers of the Triton kernels, and the exact mode's coverage kernel.

A mesh is one object in one image. Its window is the part of the image that its faces may touch, in
whole tiles of TILE x TILE pixels. Windows are packed one after the other, row by row, so memory
grows with the covered pixels. No two programs add to the same address, so results are
deterministic. `missed` is 1 - coverage, the probability that the mesh misses the pixel.

    windows          bound_faces         per mesh          pixels that faces touch, and the window
    kernels          cover_tiles         per packed tile   missed, order value
    faces            corner_gradients    per few faces     gradient of each face's corners
                     gather_vertices     per few vertices  gradient of each vertex
    outline_kernels  sum_layers          per few edges     change in the number of faces
                     certify_pieces      per few pieces    pieces without a face beyond them
                     trace_tiles         per packed tile   missed, order value, nearest piece
                     end_gradients       per few pieces    gradient of the edge's ends
    backend          composite_tiles     per image tile    masks, front, depth
                     composite_backward  per image tile    gradient of packed pixels

`cover_tiles` and `faces` implement the exact mode, `outline_kernels` the fast mode. Block shapes
are chosen for an H200 by counting instructions and registers, not yet by measurement.
"""

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


@triton.jit
def cover_tiles(
    pixels, inverse_depths, faces, face_bounds, block_bounds, windows, first_tiles, tile_meshes,
    missed, order, vertex_count, block_count, sigma, blur,
):  # pragma: no cover - compiled  # fmt: skip
    """Draw one mesh in one tile: 1 - coverage, and the order value, in the exact mode.

    The order value is the depth at pixels whose centre lies in a face, the negative depth in the
    halo (the blur outside the faces), and minus infinity elsewhere.
    """
    mesh, top_row, left_column, row, column, at = tile_pixels(windows, first_tiles, tile_meshes)
    real = missed.dtype.element_ty
    px, py = column.to(real) + 0.5, row.to(real) + 0.5
    # odds = prod_f (1 + e^x_f). If it overflows to infinity, missed = 1 / odds is 0.
    odds = tl.full((TILE * TILE,), 1, real)
    inverse_inside = tl.zeros((TILE * TILE,), real)  # 1 / depth; 0 is infinitely far
    inverse_halo = tl.zeros((TILE * TILE,), real)
    inverse_sigma = 1.0 / sigma
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
                    pixels, faces, face, mesh * vertex_count, True, real
                )
                ia, ib = tl.load(inverse_depths + a), tl.load(inverse_depths + b)
                ic = tl.load(inverse_depths + c)
                rx, ry, _, wc = to_edge(px, py, ax, ay, bx, by)
                distance = rx * rx + ry * ry
                rx, ry, _, wa = to_edge(px, py, bx, by, cx, cy)
                distance = tl.minimum(distance, rx * rx + ry * ry)
                rx, ry, _, wb = to_edge(px, py, cx, cy, ax, ay)
                distance = tl.minimum(distance, rx * rx + ry * ry)
                area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
                turn = tl.where(area > 0, 1.0, -1.0)
                wa, wb, wc = wa * turn, wb * turn, wc * turn
                least = tl.minimum(tl.minimum(wa, wb), wc)
                inside = least > 0
                contained = least + SLACK * tl.abs(area) > 0
                halo = (distance < blur) & (inside == 0)
                x = tl.minimum(tl.where(inside, distance, -distance) * inverse_sigma, 80.0)
                odds *= tl.where(inside | halo, 1.0 + tl.exp(x), 1.0)
                wa, wb, wc = tl.maximum(wa, 0.0), tl.maximum(wb, 0.0), tl.maximum(wc, 0.0)
                total = wa + wb + wc
                # Far from a sliver, all weights may round to 0; then the nearest corner is used.
                inverse = tl.where(
                    total > 0,
                    (wa * ia + wb * ib + wc * ic) / tl.where(total > 0, total, 1.0),
                    tl.maximum(tl.maximum(ia, ib), ic),
                )
                inverse_inside = tl.maximum(inverse_inside, tl.where(contained, inverse, 0.0))
                inverse_halo = tl.maximum(inverse_halo, tl.where(halo, inverse, 0.0))
    tl.store(missed + at, 1.0 / odds)
    value = tl.where(inverse_inside > 0, 1.0 / inverse_inside, -1.0 / inverse_halo)
    tl.store(order + at, value)
