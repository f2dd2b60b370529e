"""Triton kernels that find which edges, and which pieces of them, are the outline of a mesh."""

from typing import no_type_check

from sceneprior.silhouettes.cuda.kernels import MIN_AREA, tl, triton, vertex_at64, vertices_of

EDGES = tl.constexpr(128)
"""Edges of one program of `sum_layers`."""

PIECES, LINES = tl.constexpr(16), tl.constexpr(32)
"""Pieces of one program of `certify_pieces`, and edges that each takes at once."""


# no_type_check: the tests' type hook wraps every function, and Triton cannot compile a wrapper.
@triton.jit
@no_type_check
def sum_layers(
    pixels, depths, faces, windows, first_faces, edge_faces, edge_ways, layers,
    vertex_count, edge_count, near,
):  # pragma: no cover - compiled  # fmt: skip
    """How many faces more lie over the image to the left of each edge than to its right."""
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
        a, b, c = vertices_of(faces, face, mesh * vertex_count, here)
        ax, ay = vertex_at64(pixels, a, here)
        bx, by = vertex_at64(pixels, b, here)
        cx, cy = vertex_at64(pixels, c, here)
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        keep = here & (tl.abs(area) > MIN_AREA)
        keep &= tl.load(depths + a, mask=here, other=0) > near
        keep &= tl.load(depths + b, mask=here, other=0) > near
        keep &= tl.load(depths + c, mask=here, other=0) > near
        total += tl.where(keep, tl.where(area > 0, way, -way), 0)
    tl.store(layers + mesh * edge_count + edge, total, mask=exists)


@triton.jit
@no_type_check
def certify_pieces(
    points, piece_meshes, lines, layers, first_lines, clear, piece_count, line_count
):  # pragma: no cover - compiled
    """Whether no face lies over a point: the edges to its right add up to nothing."""
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
        ax = tl.load(lines + line, mask=here, other=0)
        ay = tl.load(lines + line_count + line, mask=here, other=0)
        bx = tl.load(lines + 2 * line_count + line, mask=here, other=0)
        by = tl.load(lines + 3 * line_count + line, mask=here, other=0)
        more = tl.load(layers + line, mask=here, other=0)
        down = by > ay
        # Going right, an edge that runs down the image is crossed from its left side.
        beyond = ((y - ay) * (bx - ax) > (x - ax) * (by - ay)) == down
        crossed = here & ((ay <= y) != (by <= y)) & beyond
        over += tl.where(crossed, tl.where(down, more, -more), 0)
    piece = tl.program_id(0) * PIECES + tl.arange(0, PIECES)
    free = (tl.sum(over, axis=1) <= 0).to(tl.uint8)
    tl.store(clear + piece, free, mask=piece < piece_count)
