"""ReSpace's OOB, MBL and PBL: volumes outside the room and shared by objects, in voxels."""

import numpy as np
import shapely
from jaxtyping import Bool, Int

from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shell import ceiling_height, floor_polygon
from sceneprior.evaluation.metric import USED, Counts, metric
from sceneprior.evaluation.surfaces import (
    FLUSH_M,
    Voxels,
    bounds,
    footprint,
    triangles_of,
    voxelize,
)

PITCH_M = 0.05
VALID_M3 = 0.1
"""Largest PBL of a valid room, in cubic metres."""
LEAST = 1e-7
"""Areas and volumes below this value count as 0."""


_LITRES = "mean, litres; known floors only"


@metric("respace_oob_litres", "OOB: volume out of the room (ReSpace)", _LITRES, "lower", USED)
@metric("respace_mbl_litres", "MBL: volume shared by objects (ReSpace)", _LITRES, "lower", USED)
@metric("respace_pbl_litres", "PBL: the sum of both (ReSpace)", _LITRES, "lower", USED)
@metric(
    "respace_valid", "Rooms with a PBL of at most 100 litres (ReSpace)",
    "share; known floors only", "higher", USED,
)  # fmt: skip
def voxel_loss(scene: Scene) -> Counts:
    """ReSpace's OOB (volume of objects outside the room) and MBL (volume shared by pairs of
    objects, mesh-based loss). Their sum is PBL (VBL in the paper). Unknown without a floor.

    An object's voxels of 5 cm are those that its surface passes through or encloses. An object is
    voxelized around the centre of its lower face, which is then moved to a whole voxel: rounded
    down in x and z, and to the nearest in y. The room is the prism over its floor. Voxels are
    counted only for objects whose box leaves the room, and for pairs whose boxes share volume.

    A box leaves the room if it does so by more than 1 mm (`FLUSH_M`), since otherwise a wardrobe
    flush with a wall could lose a whole layer of voxels to the outside.

    Since surfaces fill the voxels that they touch, an object counts as up to one voxel larger, and
    objects that overlap by a millimetre may share a layer of voxels.

    Source:
        GradientSpaces/respace, src/eval.py, read in a third-party copy of the file (Bucher and
        Armeni, arXiv 2506.02459). There, a room is the voxelized mesh of its outline; here, a voxel
        is in the room if it touches the outline's area. There, heights are also rounded down, so
        that a bed 1 mm below the floor loses a layer. The room's height is the ceiling's, or, if
        that is unknown, `ceiling_height`.
    """
    floor = floor_polygon(scene)
    if floor is None:
        return {}
    top_m = ceiling_height(scene)
    wider = floor.buffer(FLUSH_M, join_style="mitre")
    plans = [shapely.Polygon(footprint(item)) for item in scene.objects]
    spans = [_span(item) for item in scene.objects]
    cells: dict[int, Voxels] = {}

    def voxels(row: int) -> Voxels:
        if row not in cells:
            cells[row] = _placed(scene.objects[row])
        return cells[row]

    outside = shared = 0
    for row, (plan, (low, high)) in enumerate(zip(plans, spans, strict=True)):
        kept = _area(plan, wider) * max(min(high, top_m + FLUSH_M) - max(low, -FLUSH_M), 0.0)
        if plan.area * (high - low) - kept >= LEAST:
            outside += _outside(voxels(row), floor, top_m)
        for other in range(row + 1, len(plans)):
            height = min(high, spans[other][1]) - max(low, spans[other][0])
            if height > 0 and _area(plan, plans[other]) * height >= LEAST:
                shared += _shared(voxels(row), voxels(other))
    oob_m3, mbl_m3 = outside * PITCH_M**3, shared * PITCH_M**3
    return {
        "respace_oob_litres": (1000 * oob_m3, 1.0),
        "respace_mbl_litres": (1000 * mbl_m3, 1.0),
        "respace_pbl_litres": (1000 * (oob_m3 + mbl_m3), 1.0),
        "respace_valid": (float(oob_m3 + mbl_m3 <= VALID_M3), 1.0),
    }


def _area(a: shapely.Geometry, b: shapely.Geometry) -> float:
    area = float(shapely.intersection(a, b).area)
    return area if area >= LEAST else 0.0


def _span(item: SceneObject) -> tuple[float, float]:
    """Heights of the lowest and highest points of an object's surface."""
    low, high = bounds(triangles_of(item))[:, 1].tolist()
    return low, high


def _placed(item: SceneObject) -> Voxels:
    """An object's voxels in the room's grid."""
    foot = np.array([item.center_m[0], _span(item)[0], item.center_m[2]])
    own = voxelize(triangles_of(item) - foot, PITCH_M)
    at = np.floor(foot / PITCH_M + 1e-9).astype(np.int64)
    at[1] = round(foot[1] / PITCH_M)
    half = np.array(own.cells.shape) // 2
    return Voxels(own.cells, at - np.array([half[0], 0, half[2]]))


def _outside(voxels: Voxels, floor: shapely.Geometry, top_m: float) -> int:
    x, y, z = (
        start + np.arange(n) for start, n in zip(voxels.first, voxels.cells.shape, strict=True)
    )
    grid_x, grid_z = np.meshgrid(x * PITCH_M, z * PITCH_M, indexing="ij")
    half = PITCH_M / 2
    squares = shapely.box(grid_x - half, grid_z - half, grid_x + half, grid_z + half)
    within: Bool[np.ndarray, "x z"] = shapely.intersects(floor, squares)
    level = (y >= 0) & (y <= round(top_m / PITCH_M))
    return int((voxels.cells & ~(within[:, None] & level[None, :, None])).sum())


def _shared(a: Voxels, b: Voxels) -> int:
    low: Int[np.ndarray, 3] = np.maximum(a.first, b.first)
    high = np.minimum(a.first + a.cells.shape, b.first + b.cells.shape)
    if (high <= low).any():
        return 0
    parts = [
        each.cells[
            tuple(slice(s, e) for s, e in zip(low - each.first, high - each.first, strict=True))
        ]
        for each in (a, b)
    ]
    return int((parts[0] & parts[1]).sum())
