"""Feet for furniture that would fall over: its centre of mass lies outside its support polygon."""

from dataclasses import replace

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.colliders import colliders, mesh_of, points_of, volume_and_centroid
from sceneprior.core.scene import Mesh, SceneObject, Solid, Textured

CONTACT_M = 1e-3
"""Height above the lowest point up to which a body touches the floor."""
MARGIN = 0.2
"""Minimum distance of the centre of mass from the edge of the support polygon, as a share of the
distance of the centre of mass from the outline of the object seen from above."""
WIDE_M = 0.05
"""Width of a foot."""
LOWER = 0.2
"""Lower part of a body, as a share of its height, that a foot may support."""
HIGH = 0.3
"""Weight of the height of a body above the floor, relative to its horizontal distance from the
corner, when choosing the body that a foot supports."""
INTO_M = 0.01
"""Length by which a foot reaches into the body above it."""


def with_feet(item: SceneObject) -> SceneObject:
    """The object, with feet near its four corners if it would fall over without them.

    Feet are boxes, added to the object's solids and mesh. A corner near which a body already stands
    on the floor gets none.
    """
    if stands_safely(item):
        return item
    bodies = colliders(item)
    feet = _feet(bodies)
    mesh = item.mesh and _joined(item.mesh, *map(mesh_of, feet))
    textured = item.textured and (*item.textured, *(Textured(mesh_of(foot)) for foot in feet))
    return replace(item, solids=(*bodies, *feet), mesh=mesh, textured=textured)


def stands_safely(item: SceneObject) -> bool:
    """True if the centre of mass lies inside the object's support polygon, which is the convex hull
    of its contacts with the floor seen from above, with a margin (`MARGIN`)."""
    bodies = colliders(item)
    points = np.concatenate([points_of(body) for body in bodies])
    low = points[points[:, 1] <= points[:, 1].min() + CONTACT_M][:, ::2]
    support, plan = (
        shapely.convex_hull(shapely.MultiPoint(each)) for each in (low, points[:, ::2])
    )
    volumes, centers = zip(*(volume_and_centroid(body) for body in bodies), strict=True)
    middle = shapely.Point(np.average(np.array(centers), axis=0, weights=np.array(volumes))[::2])
    if not support.contains(middle):
        return False
    return bool(middle.distance(support.exterior) >= MARGIN * middle.distance(plan.exterior))


def _feet(bodies: tuple[Solid | Mesh, ...]) -> tuple[Solid, ...]:
    clouds = [points_of(body) for body in bodies]
    floor_m = min(float(points[:, 1].min()) for points in clouds)
    every = np.concatenate(clouds)
    low, high = every[:, ::2].min(axis=0), every[:, ::2].max(axis=0)
    half = np.minimum(WIDE_M, (high - low) / 4) / 2
    feet = []
    for corner in ((0, 0), (0, 1), (1, 0), (1, 1)):
        at = np.where(corner, high - half, low + half)
        place, top_m = _under(clouds, at, floor_m)
        if top_m - floor_m <= CONTACT_M:
            continue  # a body stands on the floor there
        feet.append(
            Solid(
                "box",
                (float(place[0] - half[0]), floor_m, float(place[1] - half[1])),
                (float(place[0] + half[0]), top_m + INTO_M, float(place[1] + half[1])),
            )
        )
    return tuple(feet)


def _under(
    clouds: list[Float[np.ndarray, "_ 3"]], at: Float[np.ndarray, "2"], floor_m: float
) -> tuple[Float[np.ndarray, "2"], float]:
    """Position (x, z) and top of the foot at a corner, `at`. The foot supports the body with the
    lowest cost, which favours low bodies near the corner."""
    found = []
    for points in clouds:
        # Only the lower part, because the rim of a round body may be as high as the object.
        heights = points[:, 1]
        lower = points[heights <= heights.min() + LOWER * np.ptp(heights)]
        plan = shapely.convex_hull(shapely.MultiPoint(lower[:, ::2]))
        nearest = shapely.get_coordinates(shapely.shortest_line(shapely.Point(at), plan))[-1]
        cost = np.abs(nearest - at).sum() + HIGH * (heights.min() - floor_m)
        found.append((float(cost), nearest, float(lower[:, 1].max())))
    _, place, top_m = min(found, key=lambda one: one[0])
    return place, top_m


def _joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]),
    )
