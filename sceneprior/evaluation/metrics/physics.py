"""Physical plausibility: volumes out of the room and shared by objects, in voxels (ReSpace), and
objects that stay where they are under gravity, simulated by MuJoCo."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import shapely
from jaxtyping import Bool, Float, Int

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shell import ceiling_height, floor_polygon
from sceneprior.evaluation.geometry import (
    AT_ONCE,
    FLUSH_M,
    Triangles,
    bounds,
    footprint,
    triangles_of,
)
from sceneprior.evaluation.metric import USED, Counts, TableColumn, metric
from sceneprior.render.scene_simulators import TIMESTEP_S, scene_to_mjcf

PITCH_M = 0.05
VALID_M3 = 0.1
"""Largest PBL of a valid room, in cubic metres."""
LEAST = 1e-7
"""Areas and volumes below this value count as 0."""
SECONDS = 5.0
MOVED_M, TURNED_RAD = 0.01, 0.1
"""Largest displacement and rotation of a stable object."""

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
    spans = [bounds(triangles_of(item))[:, 1].tolist() for item in scene.objects]
    voxels = cache(lambda row: voxels_of(scene.objects[row]))
    outside = shared = 0
    for row, (plan, (low, high)) in enumerate(zip(plans, spans, strict=True)):
        kept = _area(plan, wider) * max(min(high, top_m + FLUSH_M) - max(low, -FLUSH_M), 0.0)
        if plan.area * (high - low) - kept >= LEAST:
            cells = voxels(row)
            _, first, column = np.unique(
                cells @ [1 << 20, 0, 1], return_index=True, return_inverse=True
            )
            middle, half = (cells[first, ::2] * PITCH_M).T, PITCH_M / 2
            squares = shapely.box(*(middle - half), *(middle + half))
            within = shapely.intersects(floor, squares)[column]
            level = (cells[:, 1] >= 0) & (cells[:, 1] <= round(top_m / PITCH_M))
            outside += int((~within | ~level).sum())
        for other in range(row + 1, len(plans)):
            height = min(high, spans[other][1]) - max(low, spans[other][0])
            if height > 0 and _area(plan, plans[other]) * height >= LEAST:
                one, two = (voxels(each) @ [1 << 40, 1 << 20, 1] for each in (row, other))
                shared += len(np.intersect1d(one, two, assume_unique=True))
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


def voxels_of(item: SceneObject) -> Int[np.ndarray, "cells 3"]:
    """An object's cells in the room's grid, by their centres in units of `PITCH_M`."""
    surface = triangles_of(item)
    foot = np.array([item.center_m[0], bounds(surface)[0, 1], item.center_m[2]])
    cells = voxelize(surface - foot)
    at = np.floor(foot / PITCH_M + 1e-9).astype(np.int64)
    at[1] = round(foot[1] / PITCH_M)
    low, high = cells.min(axis=0), cells.max(axis=0)
    return cells - low + at - (high - low + 1) // 2 * [1, 0, 1]


def voxelize(surface: Triangles) -> Int[np.ndarray, "cells 3"]:
    """Cells that a surface passes through or encloses, by their centres in units of `PITCH_M`.

    Points on the surface, at most half a pitch apart, are rounded to cells, as in trimesh's
    `voxelized(pitch).fill()`, which divides triangles until their edges are that short.
    """
    from scipy.ndimage import binary_fill_holes

    longest = np.linalg.norm(np.roll(surface, -1, axis=1) - surface, axis=2).max(axis=1)
    steps = np.maximum(np.ceil(longest / (PITCH_M / 2)), 1)
    # Steps are powers of two, so that there are few distinct grids.
    steps = 2 ** np.ceil(np.log2(steps)).astype(np.int64)
    low, high = np.round(bounds(surface) / PITCH_M).astype(np.int64)
    grid = np.zeros(high - low + 1, dtype=bool)
    for count in np.unique(steps):
        u, v = np.divmod(np.arange((count + 1) ** 2), count + 1)
        weights = np.stack([count - u - v, u, v], axis=1)[u + v <= count] / count
        some = surface[steps == count]
        for few in np.array_split(some, len(some) * len(weights) // AT_ONCE + 1):
            points = np.round(np.matmul(weights, few) / PITCH_M).astype(np.int64) - low
            # A corner's coordinate, computed as a weighted sum, may round to the next cell.
            grid[tuple(points.clip(0, high - low).reshape(-1, 3).T)] = True
    return np.argwhere(binary_fill_holes(grid)) + low


@dataclass(frozen=True)
class Settled:
    """Motion of a scene's objects during a physics simulation, and how far they overlap at its
    start."""

    moved_m: Float[np.ndarray, " objects"]
    turned_rad: Float[np.ndarray, " objects"]
    penetration_m: float
    """Largest penetration depth of two objects, or of an object and the room, at the start."""

    @property
    def stable(self) -> Bool[np.ndarray, " objects"]:
        """True for objects that moved at most 1 cm and turned at most 0.1 rad."""
        return (self.moved_m <= MOVED_M) & (self.turned_rad <= TURNED_RAD)


def settle(scene: Scene) -> Settled:
    """Simulate a scene with gravity, in steps of 1 ms, as `scene_to_mjcf` describes it.

    Objects that hang are held in place and count as stable.

    Raises:
        InputError: `mujoco` is not installed.

    Source:
        The stability of nepfaff/SceneEval: 5 s, and an object is stable if it moved at most 1 cm
        and turned at most 0.1 rad. There, every object weighs 1 kg; here, masses are those of
        `core/colliders.py`.
    """
    try:
        import mujoco
    except ImportError:
        raise InputError(
            "Simulating rooms needs one more package: pip install 'sceneprior[sim]'."
        ) from None
    model = mujoco.MjModel.from_xml_string(scene_to_mjcf(scene))
    state = mujoco.MjData(model)
    mujoco.mj_forward(model, state)
    depth = max((-float(contact.dist) for contact in state.contact), default=0.0)
    # Body 0 is the world; the objects follow in their order.
    bodies = slice(1, 1 + len(scene.objects))
    start, turned = state.xpos[bodies].copy(), state.xquat[bodies].copy()
    for _ in range(round(SECONDS / TIMESTEP_S)):
        mujoco.mj_step(model, state)
    moved = np.linalg.norm(state.xpos[bodies] - start, axis=1)
    alike = np.abs((state.xquat[bodies] * turned).sum(axis=1)).clip(max=1)
    return Settled(moved, 2 * np.arccos(alike), max(depth, 0.0))


@metric(
    "stable_share", "Stable for 5 s in MuJoCo, as generated", "share of objects", "higher", USED,
    column=TableColumn("stable", 2, "stable: objects that stay put for 5 s in MuJoCo"),
    needs="solids of the objects (--settle all divides meshes, a minute or two each)",
    protocol={
        "stability": f"{SECONDS:g} s of MuJoCo in the rooms as they are, without walls; "
        f"moved at most {MOVED_M} m, turned at most {TURNED_RAD} rad"
    },
)  # fmt: skip
def stable_count(scene: Scene) -> Counts:
    """Numbers of stable objects and of all objects of a scene."""
    stable = settle(scene).stable if scene.objects else np.zeros(0)
    return {"stable_share": (float(stable.sum()), float(len(stable)))}
