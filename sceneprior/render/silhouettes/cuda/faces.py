"""The exact mode on CUDA: coverage of each mesh, and its gradient.

The backward pass has two kernels: one sums the gradients of each face's corners over the pixels of
the face, the other adds them up by vertex. The order of each sum is fixed.
"""

import torch
from torch import Tensor

from sceneprior.render.silhouettes.cuda.kernels import (
    BLOCK,
    SLACK,
    TILE,
    Edges,
    Windows,
    are_drawn,
    corners_of,
    first_bit,
    hits,
    launch,
    tile_pixels,
    tl,
    to_edge,
    triton,
    window,
)
from sceneprior.render.silhouettes.reference import Settings

FACES, PIXELS = 8, 8
"""Faces per backward program, and pixels processed at once for each. More faces need more registers
(about 100 for 8, 190 for 16); with more pixels, lanes idle on small faces."""

VERTICES = 128
"""Vertices per program of `gather_vertices`."""


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


@triton.jit
def corner_gradients(
    pixels, faces, face_bounds, windows, first_tiles, upstream, by_corner,
    vertex_count, face_count, block_count, sigma, blur, FACES: tl.constexpr, PIXELS: tl.constexpr,
):  # pragma: no cover - compiled  # fmt: skip
    """Gradients of each face's corners, summed over its pixels.

    The pixels of a face are split between lanes, whose sums are added at the end.
    """
    programs = tl.cdiv(face_count, FACES)
    mesh = tl.program_id(0).to(tl.int64) // programs
    face = (tl.program_id(0) % programs) * FACES + tl.arange(0, FACES)[:, None]
    exists = face < face_count
    row_size = block_count * BLOCK
    bounds = face_bounds + mesh * 4 * row_size + face
    first_row = tl.load(bounds, mask=exists, other=0).to(tl.int32)
    last_row = tl.load(bounds + row_size, mask=exists, other=-1).to(tl.int32)
    first_column = tl.load(bounds + 2 * row_size, mask=exists, other=0).to(tl.int32)
    last_column = tl.load(bounds + 3 * row_size, mask=exists, other=-1).to(tl.int32)
    columns = tl.maximum(last_column - first_column + 1, 1)
    count = tl.where(last_row >= 0, (last_row - first_row + 1) * columns, 0)
    most = tl.max(tl.max(count, axis=1), axis=0)
    base, stride = window(windows, first_tiles, mesh)

    real = by_corner.dtype.element_ty
    _, _, _, ax, ay, bx, by, cx, cy = corners_of(
        pixels, faces, face, mesh * vertex_count, exists, real
    )
    turn = tl.where((bx - ax) * (cy - ay) - (by - ay) * (cx - ax) > 0, 1.0, -1.0)
    gax, gay = tl.zeros((FACES, PIXELS), real), tl.zeros((FACES, PIXELS), real)
    gbx, gby = tl.zeros((FACES, PIXELS), real), tl.zeros((FACES, PIXELS), real)
    gcx, gcy = tl.zeros((FACES, PIXELS), real), tl.zeros((FACES, PIXELS), real)
    # Lane i takes the face's pixels i, i + PIXELS, ... in reading order, stepped incrementally.
    lane = tl.arange(0, PIXELS)[None, :]
    row, column = lane // columns, lane % columns
    down, along = PIXELS // columns, PIXELS % columns
    inverse_sigma = 1.0 / sigma
    for start in range(0, most, PIXELS):
        at = base + (first_row + row) * stride + first_column + column
        grad = tl.load(upstream + at, mask=start + lane < count, other=0)
        # Pixels that are certainly covered, hidden or without a loss have no gradient.
        if tl.max(tl.max(tl.abs(grad), axis=1), axis=0) > 0:
            px, py = (first_column + column).to(real) + 0.5, (first_row + row).to(real) + 0.5
            rx, ry, t, wc = to_edge(px, py, ax, ay, bx, by)
            distance = rx * rx + ry * ry
            share_a, share_b = 1.0 - t, t
            sx, sy, t, wa = to_edge(px, py, bx, by, cx, cy)
            here = sx * sx + sy * sy
            nearer = here < distance
            distance = tl.where(nearer, here, distance)
            rx, ry = tl.where(nearer, sx, rx), tl.where(nearer, sy, ry)
            share_a, share_b = tl.where(nearer, 0.0, share_a), tl.where(nearer, 1.0 - t, share_b)
            sx, sy, t, wb = to_edge(px, py, cx, cy, ax, ay)
            here = sx * sx + sy * sy
            nearer = here < distance
            distance = tl.where(nearer, here, distance)
            rx, ry = tl.where(nearer, sx, rx), tl.where(nearer, sy, ry)
            share_a, share_b = tl.where(nearer, t, share_a), tl.where(nearer, 0.0, share_b)

            inside = tl.minimum(tl.minimum(wa * turn, wb * turn), wc * turn) > 0
            sign = tl.where(inside, 1.0, -1.0)
            # dL/dx_f is `upstream` times the probability that this face covers the pixel;
            # dd_f/dcorner is -2 (p - nearest) times the corner's share of the nearest point.
            covers = 1.0 / (1.0 + tl.exp(-sign * distance * inverse_sigma))
            weight = -2.0 * grad * sign * covers * inverse_sigma
            weight = tl.where(inside | (distance < blur), weight, 0.0)
            gx, gy = weight * rx, weight * ry
            gax += share_a * gx
            gay += share_a * gy
            gbx += share_b * gx
            gby += share_b * gy
            gcx += (1.0 - share_a - share_b) * gx
            gcy += (1.0 - share_a - share_b) * gy
        wraps = column + along >= columns
        row += down + wraps.to(tl.int32)
        column += along - tl.where(wraps, columns, 0)
    face = (tl.program_id(0) % programs) * FACES + tl.arange(0, FACES)
    to = by_corner + (mesh * face_count + face) * 6
    exists = face < face_count
    tl.store(to, tl.sum(gax, axis=1), mask=exists)
    tl.store(to + 1, tl.sum(gay, axis=1), mask=exists)
    tl.store(to + 2, tl.sum(gbx, axis=1), mask=exists)
    tl.store(to + 3, tl.sum(gby, axis=1), mask=exists)
    tl.store(to + 4, tl.sum(gcx, axis=1), mask=exists)
    tl.store(to + 5, tl.sum(gcy, axis=1), mask=exists)


@triton.jit
def gather_vertices(
    by_corner, corners, first_corners, windows, gradient, vertex_count, corner_count,
    VERTICES: tl.constexpr,
):  # pragma: no cover - compiled  # fmt: skip
    """Sum gradients by vertex v over its corners[first_corners[v] : first_corners[v + 1]]."""
    programs = tl.cdiv(vertex_count, VERTICES)
    mesh = tl.program_id(0).to(tl.int64) // programs
    vertex = (tl.program_id(0) % programs) * VERTICES + tl.arange(0, VERTICES)
    exists = vertex < vertex_count
    first = tl.load(first_corners + vertex, mask=exists, other=0)
    count = tl.load(first_corners + vertex + 1, mask=exists, other=0) - first
    seen = tl.load(windows + mesh * 4 + 2) > 0
    most = tl.where(seen, tl.max(count, axis=0), 0)
    real = gradient.dtype.element_ty
    gx, gy = tl.zeros((VERTICES,), real), tl.zeros((VERTICES,), real)
    for step in range(0, most):
        here = step < count
        corner = mesh * corner_count + tl.load(corners + first + step, mask=here, other=0)
        gx += tl.load(by_corner + corner * 2, mask=here, other=0)
        gy += tl.load(by_corner + corner * 2 + 1, mask=here, other=0)
    to = gradient + (mesh * vertex_count + vertex) * 2
    tl.store(to, gx, mask=exists)
    tl.store(to + 1, gy, mask=exists)


def cover(
    pixels: Tensor, depths: Tensor, faces: Tensor, windows: Windows, settings: Settings
) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """1 - coverage and the order value at all pixels of the windows, and the inputs saved for
    `cover_backward`."""
    tiles = len(windows.tile_meshes)
    missed = pixels.new_empty(tiles * TILE.value**2)
    order = torch.empty_like(missed)
    launch(
        cover_tiles, tiles, pixels, depths.reciprocal(), faces, *windows, missed, order,
        pixels.shape[2], windows.block_bounds.shape[-1], settings.sigma_px2, settings.blur_px2,
        num_warps=1,
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
        corner_gradients, images * objects * -(-len(faces) // FACES), pixels, faces,
        face_bounds, places, first_tiles, upstream, by_corner, vertices, len(faces),
        face_bounds.shape[-1] // BLOCK.value, settings.sigma_px2, settings.blur_px2, FACES=FACES,
        PIXELS=PIXELS, num_warps=1,
    )  # fmt: skip
    return sum_by_vertex(by_corner, faces.flatten(), places, pixels)


def sum_by_vertex(by_corner: Tensor, owners: Tensor, places: Tensor, pixels: Tensor) -> Tensor:
    """Sum each mesh's corner gradients by vertex (`owners`); `places` has one row per mesh."""
    gradient = torch.empty_like(pixels)
    vertices = pixels.numel() // 2 // max(len(places), 1)
    owners, corners = owners.sort(stable=True)
    every = torch.arange(vertices + 1, dtype=owners.dtype, device=owners.device)
    launch(
        gather_vertices, len(places) * -(-vertices // VERTICES), by_corner, corners,
        torch.searchsorted(owners, every), places, gradient, vertices, len(corners),
        VERTICES=VERTICES, num_warps=4,
    )  # fmt: skip
    return gradient


EDGES = tl.constexpr(128)
"""Edges per program of `sum_layers`."""


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


def layers_of(
    pixels: Tensor,
    depths: Tensor,
    faces: Tensor,
    windows: Windows,
    settings: Settings,
    edges: Edges,
) -> Tensor:
    """(meshes, edges) int32: the faces to the left of each edge in the image, minus those to its
    right."""
    meshes, vertices = len(windows.places), pixels.shape[2]
    layers = torch.empty(meshes, len(edges.ends), dtype=torch.int32, device=pixels.device)
    programs = meshes * -(-len(edges.ends) // EDGES.value)
    launch(
        sum_layers, programs, pixels, depths, faces, windows.places,
        edges.first_faces, edges.faces, edges.ways, layers, vertices, len(edges.ends),
        settings.near_m, num_warps=4, enable_fp_fusion=False,
    )  # fmt: skip
    return layers
