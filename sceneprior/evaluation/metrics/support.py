"""SceneEval's SUPPORT: objects that rest on the floor, a wall, the ceiling or another object."""

import numpy as np
import shapely
from jaxtyping import Bool, Float

from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.colliders import support_of
from sceneprior.core.scene import Scene
from sceneprior.core.shell import floor_rectangle, rectangle
from sceneprior.evaluation.geometry import (
    Points,
    Triangles,
    area_centroid,
    bounds,
    reaching,
    triangles_of,
    vertical_crossings,
)
from sceneprior.evaluation.metric import USED, Counts, TableColumn, metric

NEAR_M = 0.01
"""Length of the rays, and thickness of the object's outermost layer, in which they start."""
LIFT_M = 0.005
"""Distance by which an object is moved against gravity before rays are cast."""
FACING = 0.9
"""Minimum cosine between gravity and the normals of faces on which rays start."""
PER_M2, FEWEST, MOST = 256, 32, 100_000
"""Rays per square metre of the largest such face, minimum per face, maximum per object."""
HIGH_M = 100.0
"""Height of walls if the ceiling is unknown."""


def supported(scene: Scene) -> Float[np.ndarray, " objects"]:
    """1 for supported objects, 0 for others, and NaN if unknown: SceneEval's SUPPORT.

    Each object has a direction of gravity: up for objects on the ceiling, backwards for objects on
    walls, down for all others. The object is moved by 5 mm against gravity. Rays of 1 cm are cast
    along gravity from the vertices within 1 cm of the outermost vertex, and from `max(32, 256 *
    area of the largest face in m2)` points on each face that consists of such vertices and faces
    gravity. A contact is the point where a ray hits the floor, a wall, the ceiling, or another
    object. Objects on the ceiling and on walls need one contact. All others need four, and their
    centroid (mean of triangles by area) above the convex hull of the contacts.

    Objects on a wall or ceiling are NaN if the scene does not know that wall or ceiling. Without a
    floor outline, the rectangle around all furniture is the floor.

    Source:
        3dlg-hcvc/SceneEval, metrics/support.py; the largest number of rays from nepfaff/SceneEval.
        There, a vision-language model decides what an object rests on; here, its class does
        (`support_of`). There, the floor is at the lowest point of all objects; here, at height 0. A
        wall object with unknown yaw is tested in four directions, and also as a standing object,
        such as a television on its stand.
    """
    surfaces = [triangles_of(item) for item in scene.objects]
    planes = _planes(scene)
    found = np.full(len(surfaces), np.nan)
    for row, item in enumerate(scene.objects):
        others = np.concatenate([*surfaces[:row], *surfaces[row + 1 :], *planes])
        kind = support_of(item)
        if kind == "ceiling":
            up = np.array([0.0, 1.0, 0.0])
            if scene.ceiling_m is not None:
                found[row] = len(_contacts(surfaces[row], others, up, row)) > 0
        elif _stands(surfaces[row], others, row):
            found[row] = 1
        elif kind == "ground":
            found[row] = 0
        elif scene.floor_m is not None:
            yaws_rad = np.arange(4) * np.pi / 2
            if item.turned is not None:
                yaws_rad = np.array([item.turned.yaw_rad])
            back = yaw_rotation(yaws_rad) @ [0.0, 0.0, -1.0]
            found[row] = any(len(_contacts(surfaces[row], others, each, row)) for each in back)
    return found


def _stands(surface: Triangles, others: Triangles, seed: int) -> bool:
    contacts = _contacts(surface, others, np.array([0.0, -1.0, 0.0]), seed)
    if len(contacts) < 4 or len(np.unique(contacts, axis=0)) < 3:
        return False
    hull = shapely.convex_hull(shapely.MultiPoint(contacts[:, ::2]))
    center = area_centroid(surface)
    return bool(hull.area > 0 and shapely.intersects_xy(hull, center[0], center[2]))


def _contacts(
    surface: Triangles, others: Triangles, gravity: Float[np.ndarray, "3"], seed: int
) -> Points:
    """Points where an object's rays hit other surfaces, in a frame in which gravity is -y."""
    up = np.array([0.0, 1.0, 0.0])
    turn = np.array([np.cross(-gravity, up), -gravity, up])
    if gravity[1]:
        turn = np.diag([1.0, -gravity[1], -gravity[1]])
    surface = surface @ turn.T + np.array([0.0, LIFT_M, 0.0])
    starts = _ray_starts(surface, seed)
    others = others @ turn.T
    low, high = starts.min(axis=0), starts.max(axis=0)
    low[1] -= NEAR_M
    hits = vertical_crossings(starts, others[reaching(others, low, high)])
    distance = starts[hits.point, 1] - hits.height_m
    near = (distance >= 0) & (distance < NEAR_M)
    contacts = starts[hits.point[near]]
    contacts[:, 1] = hits.height_m[near]
    return contacts


def _ray_starts(surface: Triangles, seed: int) -> Points:
    level = surface[:, :, 1] <= bounds(surface)[0, 1] + NEAR_M
    vertices = np.unique(surface[level], axis=0)
    normals = np.cross(surface[:, 1] - surface[:, 0], surface[:, 2] - surface[:, 0])
    areas = np.linalg.norm(normals, axis=1) / 2
    facing = level.all(axis=1) & (np.abs(normals[:, 1]) > FACING * 2 * areas)
    faces = surface[facing]
    if not len(faces):
        return np.asarray(vertices)
    count = max(FEWEST, int(areas[facing].max() * PER_M2))
    count = max(min(count, MOST // len(faces)), 1)
    u, v = np.random.default_rng(seed).random((2, len(faces), count, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    sides = faces[:, 1:] - faces[:, :1]
    points = faces[:, :1] + u * sides[:, :1] + v * sides[:, 1:]
    return np.concatenate([vertices, points.reshape(-1, 3)])


def _planes(scene: Scene) -> list[Triangles]:
    """Triangles of the floor, the ceiling and the walls, as far as the scene knows them."""
    outline = scene.floor_m if scene.floor_m is not None else rectangle(*floor_rectangle(scene))
    outline = np.asarray(outline, dtype=np.float64)
    pieces = shapely.get_parts(
        shapely.constrained_delaunay_triangles(shapely.make_valid(shapely.Polygon(outline)))
    )
    flat = np.array([shapely.get_coordinates(piece)[:3] for piece in pieces])
    planes = [np.insert(flat, 1, 0.0, axis=2)]
    if scene.ceiling_m is not None:
        planes.append(np.insert(flat, 1, scene.ceiling_m, axis=2))
    if scene.floor_m is not None:
        top = HIGH_M if scene.ceiling_m is None else scene.ceiling_m
        low, high = (np.insert(outline, 1, height, axis=1) for height in (0.0, top))
        ends = [np.roll(low, -1, axis=0), np.roll(high, -1, axis=0)]
        planes += [np.stack([low, *ends], axis=1), np.stack([low, ends[1], high], axis=1)]
    return planes


@metric(
    "sceneeval_supported", "SUPPORT: objects that rest on something (SceneEval)", "share",
    "higher", USED,
    protocol={"support": "expected by class (support_of), floor at height 0"},
    column=TableColumn("supported", 2, "supported: objects that rest on something"),
)  # fmt: skip
def _support(scene: Scene) -> Counts:
    found = supported(scene)
    known: Bool[np.ndarray, " objects"] = ~np.isnan(found)
    return {"sceneeval_supported": (float(found[known].sum()), float(known.sum()))}
