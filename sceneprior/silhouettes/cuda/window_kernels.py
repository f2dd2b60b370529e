"""The Triton kernel that finds which part of an image each mesh may touch."""

from typing import no_type_check

from sceneprior.silhouettes.cuda.kernels import (
    BLOCK,
    EMPTY,
    MIN_AREA,
    TILE,
    tl,
    triton,
    vertex_at,
    vertices_of,
)


# no_type_check: the tests' type hook wraps every function, and Triton cannot compile a wrapper.
@triton.jit
@no_type_check
def bound_faces(
    pixels, depths, faces, drawn, face_bounds, block_bounds, windows,
    vertex_count, face_count, block_count, height, width, reach, near, GROUP: tl.constexpr,
):  # pragma: no cover - compiled  # fmt: skip
    """First and last row, first and last column that each face, block and mesh may touch."""
    mesh = tl.program_id(0).to(tl.int64)
    shown = tl.where(tl.load(drawn + mesh) != 0, face_count, 0)
    mesh_first_row, mesh_last_row = height, -1
    mesh_first_column, mesh_last_column = width, -1
    for group in range(0, block_count, GROUP):
        block = group + tl.arange(0, GROUP)
        face = block[:, None] * BLOCK + tl.arange(0, BLOCK)[None, :]
        exists = face < shown
        a, b, c = vertices_of(faces, face, mesh * vertex_count, exists)
        ax, ay = vertex_at(pixels, a, exists)
        bx, by = vertex_at(pixels, b, exists)
        cx, cy = vertex_at(pixels, c, exists)
        nearest = tl.minimum(
            tl.load(depths + a, mask=exists, other=0), tl.load(depths + b, mask=exists, other=0)
        )
        nearest = tl.minimum(nearest, tl.load(depths + c, mask=exists, other=0))
        area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
        keep = exists & (nearest > near) & (tl.abs(area) > MIN_AREA)
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
        tl.store(to, first_row.to(tl.int16), mask=known)
        tl.store(to + row_size, last_row.to(tl.int16), mask=known)
        tl.store(to + 2 * row_size, first_column.to(tl.int16), mask=known)
        tl.store(to + 3 * row_size, last_column.to(tl.int16), mask=known)
        low_row, high_row = tl.min(first_row, axis=1), tl.max(last_row, axis=1)
        low_column, high_column = tl.min(first_column, axis=1), tl.max(last_column, axis=1)
        to = block_bounds + mesh * 4 * block_count + block
        known = block < block_count
        tl.store(to, low_row.to(tl.int16), mask=known)
        tl.store(to + block_count, high_row.to(tl.int16), mask=known)
        tl.store(to + 2 * block_count, low_column.to(tl.int16), mask=known)
        tl.store(to + 3 * block_count, high_column.to(tl.int16), mask=known)
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
