"""Placements, surfaces, the floor and the room's own frame, from the numbers of a house's JSON."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import shapely
import shapely.affinity

from sceneprior.errors import InputError

FAR_M = 1e5
"""No house is this large; such numbers are damage."""
DEFAULT_HEIGHT_M = 2.8
"""Ceiling height of the few rooms with neither inner walls nor a ceiling."""
_LEAST_FLOOR_M2 = 0.1
_CRACK_M = 0.1

Floor: TypeAlias = shapely.Polygon | shapely.MultiPolygon


@dataclass(frozen=True)
class Placement:
    """Where a child of a room stands in the house."""

    matrix: np.ndarray
    """(4, 4) float64: scale, turn, place."""
    scale: np.ndarray
    """(3,) as the file states it; negative where mirrored."""


@dataclass(frozen=True)
class Surface:
    """A floor, wall or ceiling in the house's frame."""

    vertices_m: np.ndarray
    """(V, 3)."""
    faces: np.ndarray
    """(F, 3); may be none."""
    unusable: int
    """Triangles whose corners are no places, or are not there."""


def numbers(values: Any) -> np.ndarray:
    """Numbers, or strings of numbers, or one string with all of them.

    Raises:
        InputError: they are something else.
    """
    if isinstance(values, str):
        values = values.replace(",", " ").strip("[]() ").split()
    if values is None or not isinstance(values, list):
        raise InputError("what should be a list of numbers is none")
    try:
        return np.array([float(value) for value in values])
    except (TypeError, ValueError, OverflowError):
        raise InputError("what should be a list of numbers holds something else") from None


def placement_of(child: dict[str, Any], required: tuple[str, ...] = ()) -> Placement:
    """Where a child stands; quaternions are x, y, z, w, of any length but zero.

    Args:
        child: `pos`, `rot` and `scale` default to none at all.
        required: Keys without a default.

    Raises:
        InputError: it is incomplete, or holds numbers that are no places.
    """
    for key in required:
        if child.get(key) is None:
            raise InputError(f"its placement has no {key}")
    place = numbers(child.get("pos", [0, 0, 0]))
    quaternion = numbers(child.get("rot", [0, 0, 0, 1]))
    scale = numbers(child.get("scale", [1, 1, 1]))
    if len(place) != 3 or len(quaternion) != 4 or len(scale) != 3:
        raise InputError("its placement is incomplete")
    if not (np.abs([*place, *scale, *quaternion]) < FAR_M).all():  # NaN is not smaller, either
        raise InputError("its placement holds numbers that are no places")
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
    matrix = np.eye(4)
    matrix[:3, :3] = rotation * scale
    matrix[:3, 3] = place
    return Placement(matrix, scale)


def surface_of(mesh: dict[str, Any], child: dict[str, Any]) -> Surface:
    """A `mesh` entry's triangles where its child puts them; one without faces has none.

    Raises:
        InputError: its numbers are none.
    """
    vertices = numbers(mesh.get("xyz") or [])
    faces = numbers(mesh.get("faces") or [])
    vertices = vertices[: len(vertices) // 3 * 3].reshape(-1, 3)
    faces = faces[: len(faces) // 3 * 3].reshape(-1, 3)
    there = faces[((faces >= 0) & (faces < len(vertices))).all(axis=1)].astype(np.int64)
    usable = np.abs(vertices) < FAR_M
    there = there[usable[there].all(axis=(1, 2))]
    matrix = placement_of(child).matrix
    placed = np.where(usable, vertices, 0.0) @ matrix[:3, :3].T + matrix[:3, 3]
    return Surface(placed, there, len(faces) - len(there))


def floor_of(surfaces: Iterable[Surface]) -> tuple[Floor, float]:
    """The union of all floor triangles in x and z, and the height of the largest floor mesh.

    Raises:
        InputError: there is none.
    """
    triangles = [surface.vertices_m[surface.faces] for surface in surfaces if len(surface.faces)]
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
    """Neighbouring floor meshes often leave a crack of rounding or of a door sill, 10 cm at most.

    Widening and narrowing closes it. Mitred joins keep right angles; at the tip of a sliver they
    are cut off, and what they still add outside of the hull was never floor.
    """
    mitre = {"join_style": "mitre", "mitre_limit": 1.5}
    return floor.buffer(_CRACK_M / 2, **mitre).buffer(-_CRACK_M / 2, **mitre) & floor.convex_hull


def room_frame(floor: Floor, floor_y: float) -> np.ndarray:
    """The 4 x 4 matrix that lays walls along the axes and the floor's centre on the origin."""
    angle = _wall_angle(floor)
    cos, sin = (math.cos(angle), math.sin(angle)) if abs(angle) > 1e-4 else (1.0, 0.0)
    matrix = np.array([[cos, 0, sin, 0], [0, 1, 0, -floor_y], [-sin, 0, cos, 0], [0, 0, 0, 1.0]])
    x1, z1, x2, z2 = shapely.affinity.affine_transform(floor, [cos, sin, -sin, cos, 0, 0]).bounds
    matrix[[0, 2], 3] = -(x1 + x2) / 2, -(z1 + z2) / 2
    return matrix


def in_frame(floor: Floor, room_from_house: np.ndarray) -> Floor:
    """The floor in the room's frame."""
    xz = [0, 2]
    turn, place = room_from_house[xz][:, xz], room_from_house[xz, 3]
    return shapely.affinity.affine_transform(floor, [*turn.ravel(), *place])


def _wall_angle(floor: Floor) -> float:
    """The turn, at most 45 degrees, after which most of the outline runs along x or z."""
    parts = getattr(floor, "geoms", [floor])
    edges = np.concatenate([np.diff(np.asarray(part.exterior.coords), axis=0) for part in parts])
    lengths = np.linalg.norm(edges, axis=1)
    # A turn by +a about y takes (x, z) = (cos t, sin t) to the angle t - a, so a = t.
    angles = np.arctan2(edges[:, 1], edges[:, 0])
    folded = (angles + math.pi / 4) % (math.pi / 2) - math.pi / 4
    # The direction that most length agrees with, then the mean of those that agree within 1 degree.
    close = np.abs((folded[:, None] - folded + math.pi / 4) % (math.pi / 2) - math.pi / 4) < 0.0175
    best = folded[int(np.argmax((close * lengths).sum(axis=1)))]
    offset = (folded - best + math.pi / 4) % (math.pi / 2) - math.pi / 4
    agreeing = np.abs(offset) < 0.0175
    return float(best + np.average(offset[agreeing], weights=lengths[agreeing]))


def height_of(surfaces: dict[str, list[Surface]], floor_y: float) -> float:
    """Floor to ceiling: the top of the inner walls, else the ceiling's, else the usual height."""
    for kind in ("WallInner", "Ceiling"):
        tops = [
            float(surface.vertices_m[surface.faces][..., 1].max())
            for surface in surfaces.get(kind, [])
            if len(surface.faces)
        ]
        if tops and max(tops) - floor_y > 1.0:
            return max(tops) - floor_y
    return DEFAULT_HEIGHT_M
