"""Triton kernels of the fast mode: coverage of packed windows by outlines, and its gradient."""

from sceneprior.render.silhouettes.cuda.kernels import (
    BLOCK,
    MIN_AREA,
    SLACK,
    TILE,
    are_drawn,
    bits_of,
    corners_of,
    first_bit,
    hits,
    tile_pixels,
    tl,
    triton,
    window,
)

EDGES = tl.constexpr(128)
"""Edges per program of `sum_layers`."""

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
def sum_layers(
    pixels, depths, faces, windows, first_faces, edge_faces, edge_ways, layers,
    vertex_count, edge_count, near,
):  # pragma: no cover - compiled  # fmt: skip
    """Number of faces to the left of each edge in the image, minus those to its right."""
    programs = tl.cdiv(edge_count, EDGES)
    mesh = tl.program_id(0).to(tl.int64) // programs
    edge = (tl.program_id(0) % programs) * EDGES + tl.arange(0, EDGES)
    exists = edge < edge_count
    first = tl.load(first_faces + edge, mask=exists, other=0)
    count = tl.load(first_faces + edge + 1, mask=exists, other=0) - first
    seen = tl.load(windows + mesh * 4 + 2) > 0
    most = tl.where(seen, tl.max(count, axis=0), 0)
    total = tl.zeros((EDGES,), tl.int32)
    for step in range(0, most):
        here = step < count
        face = tl.load(edge_faces + first + step, mask=here, other=0)
        way = tl.load(edge_ways + first + step, mask=here, other=0)
        a, b, c, ax, ay, bx, by, cx, cy = corners_of(
            pixels, faces, face, mesh * vertex_count, here, tl.float64
        )
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        keep = are_drawn(depths, a, b, c, area, here, near)
        total += tl.where(keep, tl.where(area > 0, way, -way), 0)
    tl.store(layers + mesh * edge_count + edge, total, mask=exists)


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
