"""Computes placements, surfaces, the floor and the room's frame from a house's JSON."""

import math
from collections.abc import Iterable
from typing import Any, TypeAlias

import numpy as np
import shapely
import shapely.affinity

from sceneprior.core.cameras import rigid
from sceneprior.core.errors import InputError

FAR_M = 1e5
"""Largest plausible coordinate; larger ones mean a damaged file."""
DEFAULT_HEIGHT_M = 2.8
"""Height of the few rooms that have neither inner walls nor a ceiling."""
_LEAST_FLOOR_M2 = 0.1
_CRACK_M = 0.1

Floor: TypeAlias = shapely.Polygon | shapely.MultiPolygon


def numbers(values: Any) -> np.ndarray:
    """Parse a list of numbers, a list of strings of numbers, or one string with all of them."""
    if isinstance(values, str):
        values = values.replace(",", " ").strip("[]() ").split()
    if values is None or not isinstance(values, list):
        raise InputError("expected a list of numbers, found something else")
    try:
        return np.array([float(value) for value in values])
    except (TypeError, ValueError, OverflowError):
        raise InputError("a list of numbers holds something else") from None


def placement_of(
    child: dict[str, Any], required: tuple[str, ...] = ()
) -> tuple[np.ndarray, np.ndarray]:
    """Read the pose of a room's child in the house: `pos`, `rot` and `scale`, by default identity.

    Quaternions are (x, y, z, w), of any nonzero length. The keys in `required` must be present.

    Returns:
        (4, 4) float64 matrix of scale, rotation and translation; and the scale, (3,), as stated in
        the file, negative if mirrored.
    """
    for key in required:
        if child.get(key) is None:
            raise InputError(f"its placement has no {key}")
    place = numbers(child.get("pos", [0, 0, 0]))
    quaternion = numbers(child.get("rot", [0, 0, 0, 1]))
    scale = numbers(child.get("scale", [1, 1, 1]))
    if len(place) != 3 or len(quaternion) != 4 or len(scale) != 3:
        raise InputError("its placement is incomplete")
    if not (np.abs([*place, *scale, *quaternion]) < FAR_M).all():  # NaN fails, too
        raise InputError("its placement holds implausible numbers")
    length = float(quaternion @ quaternion)
    if length < 1e-12:
        raise InputError("its placement is incomplete: the quaternion is zero")
    x, y, z, w = quaternion
    s = 2 / length
    rotation = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )
    return rigid(rotation * scale, place), scale


def surface_of(mesh: dict[str, Any], child: dict[str, Any]) -> tuple[np.ndarray, int]:
    """Triangles of a floor, wall or ceiling in the house's frame, placed by its `child` entry.

    Returns:
        (F, 3, 3) in metres, where F may be 0; and the number of triangles that are left out because
        of missing vertices or implausible coordinates.
    """
    vertices = numbers(mesh.get("xyz") or [])
    faces = numbers(mesh.get("faces") or [])
    vertices = vertices[: len(vertices) // 3 * 3].reshape(-1, 3)
    faces = faces[: len(faces) // 3 * 3].reshape(-1, 3)
    there = faces[((faces >= 0) & (faces < len(vertices))).all(axis=1)].astype(np.int64)
    usable = np.abs(vertices) < FAR_M
    there = there[usable[there].all(axis=(1, 2))]
    matrix, _ = placement_of(child)
    placed = np.where(usable, vertices, 0.0) @ matrix[:3, :3].T + matrix[:3, 3]
    return placed[there], len(faces) - len(there)


def floor_of(surfaces: Iterable[np.ndarray]) -> tuple[Floor, float]:
    """Union of all floor triangles in x and z, and the height of the largest floor mesh."""
    triangles = [surface for surface in surfaces if len(surface)]
    polygons = [shapely.polygons(corners[:, :, [0, 2]]) for corners in triangles]
    areas = [float(shapely.area(group).sum()) for group in polygons]
    if not areas or max(areas) < _LEAST_FLOOR_M2:
        raise InputError("it has no floor")
    whole = shapely.union_all([polygon for group in polygons for polygon in group])
    if whole.geom_type != "Polygon" or whole.interiors:
        whole = _without_cracks(whole)
    whole = whole.simplify(1e-4)
    if whole.geom_type not in ("Polygon", "MultiPolygon") or whole.area < _LEAST_FLOOR_M2:
        raise InputError("it has no floor")
    largest = triangles[int(np.argmax(areas))]
    return whole, float(largest[:, :, 1].min())


def _without_cracks(floor: Floor) -> Floor:
    """Close cracks of up to 10 cm between floor meshes, left by rounding or by door sills.

    The floor is dilated, then eroded. Mitred joins keep right angles, but may add spikes at the
    tips of slivers; the mitre limit and the intersection with the convex hull cut them off.
    """
    mitre = {"join_style": "mitre", "mitre_limit": 1.5}
    return floor.buffer(_CRACK_M / 2, **mitre).buffer(-_CRACK_M / 2, **mitre) & floor.convex_hull


def room_frame(floor: Floor, floor_y: float) -> np.ndarray:
    """Matrix (4, 4) that aligns the walls with the axes and moves the floor's centre to 0."""
    angle = _wall_angle(floor)
    cos, sin = (math.cos(angle), math.sin(angle)) if abs(angle) > 1e-4 else (1.0, 0.0)
    matrix = np.array([[cos, 0, sin, 0], [0, 1, 0, -floor_y], [-sin, 0, cos, 0], [0, 0, 0, 1.0]])
    x1, z1, x2, z2 = shapely.affinity.affine_transform(floor, [cos, sin, -sin, cos, 0, 0]).bounds
    matrix[[0, 2], 3] = -(x1 + x2) / 2, -(z1 + z2) / 2
    return matrix


def in_frame(floor: Floor, room_from_house: np.ndarray) -> Floor:
    """Transform the floor to the room's frame."""
    xz = [0, 2]
    turn, place = room_from_house[xz][:, xz], room_from_house[xz, 3]
    return shapely.affinity.affine_transform(floor, [*turn.ravel(), *place])


def _wall_angle(floor: Floor) -> float:
    """Rotation, at most 45 degrees, that aligns most of the floor's outline with x or z."""
    parts = getattr(floor, "geoms", [floor])
    edges = np.concatenate([np.diff(np.asarray(part.exterior.coords), axis=0) for part in parts])
    lengths = np.linalg.norm(edges, axis=1)
    # A rotation by +a about y takes (x, z) = (cos t, sin t) to the angle t - a, so a = t.
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    folded = (angles + math.pi / 4) % (math.pi / 2) - math.pi / 4
    # Pick the edge direction with the most length within 1 degree of it; average those edges.
    close = np.abs((folded[:, None] - folded + math.pi / 4) % (math.pi / 2) - math.pi / 4) < 0.0175
    best = folded[int(np.argmax((close * lengths).sum(axis=1)))]
    offset = (folded - best + math.pi / 4) % (math.pi / 2) - math.pi / 4
    agreeing = np.abs(offset) < 0.0175
    return float(best + np.average(offset[agreeing], weights=lengths[agreeing]))


def height_of(surfaces: dict[str, list[np.ndarray]], floor_y: float) -> float:
    """Room height in metres, up to the top of the inner walls, or else of the ceiling.

    Without either, it is `DEFAULT_HEIGHT_M`.
    """
    for kind in ("WallInner", "Ceiling"):
        tops = [float(part[..., 1].max()) for part in surfaces.get(kind, []) if len(part)]
        if tops and max(tops) - floor_y > 1.0:
            return max(tops) - floor_y
    return DEFAULT_HEIGHT_M
