"""Convex bodies of objects, for physics: solids, or convex parts of meshes; and their masses."""

import itertools
from functools import cache
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from sceneprior.core.boxes import BOX_FACES, CUBE_CORNERS, yaw_rotation
from sceneprior.core.parts import KIND_NAMES, convex_surface, solid_points
from sceneprior.core.scene import Mesh, SceneObject, Solid

HUNG = ("ceiling_lamp", "pendant_lamp")
"""Classes that hang from the ceiling."""
MOUNTED = ("cabinet", "shelf", "shelves", "sink", "television", "whiteboard", "wall_shelf")
"""Classes that hang on a wall if their lower face is above `MOUNTED_M`."""
MOUNTED_M = 0.4
CONCAVITY = 0.05
"""Threshold of CoACD: the largest concavity of a part that is not divided further."""
MOST_COMPONENTS = 200
"""Largest number of closed components into which a mesh is divided."""
SEARCH = {"mcts_iterations": 60, "mcts_nodes": 10, "resolution": 1000}
"""CoACD settings that take 0.5 s of CPU time per object instead of 1.3 s with its defaults, for the
same number of parts."""
LEAST_M3 = 1e-9
"""Volume assumed for flat bodies."""
THIN_M = 0.001
"""Thickness of flat bodies for simulators, which refuse flat ones."""
LEAST_KG = 0.001
"""Smallest mass; simulators refuse objects without mass."""
_FILL = {
    "box": 1.0, "cylinder": np.pi / 4, "ellipsoid": np.pi / 6, "dome": np.pi / 6, "bowl": np.pi / 6,
}  # fmt: skip


def support_of(item: SceneObject) -> Literal["ground", "wall", "ceiling"]:
    """Support of an object, by its class: the ceiling for lamps of the classes `HUNG`; a wall for
    the classes `MOUNTED` if their lower face is above 0.4 m; otherwise the ground, which includes
    other objects."""
    if item.label in HUNG:
        return "ceiling"
    bottom_m = item.center_m[1] - item.size_m[1] / 2
    return "wall" if item.label in MOUNTED and bottom_m > MOUNTED_M else "ground"


def is_fixed(item: SceneObject) -> bool:
    """True for objects that hang, which simulators hold in place."""
    return support_of(item) != "ground"


def colliders(item: SceneObject) -> tuple[Solid | Mesh, ...]:
    """Convex bodies of an object: its solids; without solids, the convex parts of its mesh
    (`convex_parts`); without a mesh, its box."""
    if item.solids:
        return item.solids
    if item.mesh is not None:
        return convex_parts(item.mesh)
    if item.turned is not None:
        corners = CUBE_CORNERS / 2 * np.asarray(item.turned.size_m)
        placed = corners @ yaw_rotation(item.turned.yaw_rad).T + np.asarray(item.center_m)
        return (Mesh(placed, BOX_FACES),)
    center, half = np.asarray(item.center_m), np.asarray(item.size_m) / 2
    return (Solid("box", tuple((center - half).tolist()), tuple((center + half).tolist())),)


def convex_parts(mesh: Mesh) -> tuple[Mesh, ...]:
    """Convex meshes whose union approximates a mesh.

    A mesh that consists of at most `MOST_COMPONENTS` closed components, such as furniture made of
    parts, is first divided into these. Nearly convex components are replaced by their convex hulls.
    CoACD decomposes the others; if it is not installed, they are replaced by their hulls, too.
    """
    coacd, parts = _coacd(), []
    for piece in closed_components(mesh):
        vertices = np.asarray(piece.vertices_m, dtype=np.float64)
        found = [Mesh(*convex_surface(vertices))]
        if volume_and_centroid(found[0])[0] <= LEAST_M3:  # flat, which simulators refuse
            corners = np.array([*itertools.product((-THIN_M / 2, THIN_M / 2), repeat=3)])
            parts.append(Mesh(*convex_surface((vertices[:, None] + corners).reshape(-1, 3))))
            continue
        enough = (1 - CONCAVITY) * volume_and_centroid(found[0])[0]
        if coacd and len(found[0].faces) and volume_and_centroid(piece)[0] < enough:
            pieces = coacd.run_coacd(
                coacd.Mesh(vertices, np.asarray(piece.faces)), threshold=CONCAVITY, **SEARCH
            )
            found = [Mesh(*convex_surface(np.asarray(each))) for each, _ in pieces] or found
        parts += found
    return tuple(parts)


def closed_components(mesh: Mesh) -> list[Mesh]:
    """Split a mesh into its connected components if there are few and all are closed, with outward
    faces; otherwise return the whole mesh."""
    import trimesh

    faces = np.asarray(mesh.faces)
    whole = trimesh.Trimesh(mesh.vertices_m, faces, process=False)
    if not whole.is_watertight:
        return [mesh]
    links, vertices = whole.edges_unique, len(mesh.vertices_m)
    of_face = trimesh.graph.connected_component_labels(links, vertices)[faces[:, 0]]
    names = np.unique(of_face)
    if len(names) > MOST_COMPONENTS:
        return [mesh]
    pieces = []
    for name in names:
        used, corners = np.unique(faces[of_face == name], return_inverse=True)
        pieces.append(Mesh(mesh.vertices_m[used], corners.reshape(-1, 3)))
    # A component with inward faces is a cavity of another component.
    outward = all(volume_and_centroid(piece)[0] > LEAST_M3 for piece in pieces)
    return pieces if pieces and outward else [mesh]


@cache
def _coacd() -> Any:
    """The optional module `coacd`, or None."""
    try:
        import coacd
    except ImportError:
        return None
    coacd.set_log_level("error")
    return coacd


def points_of(body: Solid | Mesh) -> Float[np.ndarray, "points 3"]:
    """Points whose convex hull is a body."""
    if isinstance(body, Mesh):
        return np.asarray(body.vertices_m, dtype=np.float64)
    ends = np.array([body.low_m, body.high_m]).T
    return solid_points(KIND_NAMES.index(body.kind), ends)


def mesh_of(body: Solid | Mesh) -> Mesh:
    """A body as a closed convex mesh."""
    return Mesh(*convex_surface(points_of(body)))


def volume_and_centroid(body: Solid | Mesh) -> tuple[float, Float[np.ndarray, "3"]]:
    """Volume of a body in cubic metres, and its centroid."""
    if isinstance(body, Mesh):
        corners = np.asarray(body.vertices_m, dtype=np.float64)[body.faces]
        volumes = np.linalg.det(corners) / 6
        total = volumes.sum()
        if total <= LEAST_M3:
            return LEAST_M3, corners.reshape(-1, 3).mean(axis=0)
        return float(total), (volumes[:, None] * corners.sum(axis=1) / 4).sum(axis=0) / total
    low, high = np.array(body.low_m), np.array(body.high_m)
    center = (low + high) / 2
    # The centroid of half an ellipsoid lies 3/8 of its height from the flat side.
    if body.kind in ("dome", "bowl"):
        rise = 3 / 8 * (high[1] - low[1])
        center[1] = low[1] + rise if body.kind == "dome" else high[1] - rise
    return float(_FILL[body.kind] * (high - low).prod()), center


DENSITY_KG_M3 = {
    "armchair": 55, "bar": 70, "bathtub": 90, "bed": 25, "bookshelf": 75, "cabinet": 120,
    "ceiling_lamp": 40, "chair": 25, "children_cabinet": 110, "coffee_table": 45, "counter": 120,
    "desk": 55, "double_bed": 25, "dresser": 130, "dressing_chair": 30, "dressing_table": 65,
    "kids_bed": 25, "lamp": 25, "night stand": 140, "nightstand": 140, "pendant_lamp": 25,
    "refridgerator": 110, "shelf": 75, "shelves": 75, "single_bed": 25, "sink": 90, "sofa": 40,
    "stool": 45, "table": 40, "television": 120, "toilet": 130, "tv_stand": 85, "wardrobe": 70,
    "whiteboard": 150,
}  # fmt: skip
"""Mass per volume of the bounding box, by class. Estimates, accurate to a factor of about two: the
mass of one common piece of the class over its outer volume (a chair of 5 kg in 0.5 x 0.9 x 0.45 m,
a wardrobe of 80 kg in 1 x 2 x 0.58 m, a double bed with mattress of 90 kg in 1.7 x 1 x 2.1 m)."""
OTHER_KG_M3 = 60
"""Density of classes that are not in the table."""


def mass_kg(item: SceneObject) -> float:
    """Mass of an object, from its class and the volume of its box.

    >>> mass_kg(SceneObject("double_bed", (0.0, 0.5, 0.0), (1.7, 1.0, 2.1)))
    89.25
    """
    width, height, depth = item.size_m
    mass = DENSITY_KG_M3.get(item.label, OTHER_KG_M3) * width * height * depth
    return max(round(mass, 3), LEAST_KG)
