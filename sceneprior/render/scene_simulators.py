"""Scenes as USD (y up) and as MuJoCo's MJCF (z up), in metres and kilograms.

Objects are rigid bodies with convex colliders; USD also serves viewers, without physics.
"""

import itertools
from collections.abc import Iterator, Mapping
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from jaxtyping import Float

from sceneprior.core.colliders import (
    colliders,
    is_fixed,
    mass_kg,
    mesh_of,
    points_of,
    volume_and_centroid,
)
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh, Scene, Solid
from sceneprior.core.shell import THICK_M, Shell, Wall
from sceneprior.render.appearance import (
    FLOOR_COLOR,
    WALL_COLOR,
    linear_rgba,
    node_names,
    object_colors,
    scene_meshes,
    shell_color,
)

ROOM = "/room"
GRAVITY_M_S2 = 9.81


def scene_to_usd(scene: Scene, shell: Mapping[str, Mesh], physics: bool = False) -> str:
    """The scene as the text of a USD stage.

    Each object is an Xform `/room/object_<index>_<class>` at the centre of its box, with its class
    in `userProperties:class` and its mesh as the child `shape`; meshes of the shell are children of
    `/room`. With `physics`, objects are rigid bodies with a mass, unless they hang, and the convex
    bodies of `core/colliders.py` are their colliders: cubes, cylinders and convex hulls, which are
    not drawn. Meshes of the shell are colliders themselves.

    Raises:
        InputError: `usd-core` is not installed.
    """
    try:
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics
    except ImportError:
        raise InputError("USD needs another package: pip install 'sceneprior[usd]'.") from None
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOM).GetPrim())
    if physics:
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        world = UsdPhysics.Scene.Define(stage, f"{ROOM}/physics")
        world.CreateGravityDirectionAttr(Gf.Vec3f(0, -1, 0))
        world.CreateGravityMagnitudeAttr(GRAVITY_M_S2)
    meshes, colors = scene_meshes(scene), object_colors(scene)
    for node, item, mesh, color in zip(
        node_names(scene), scene.objects, meshes, colors, strict=True
    ):
        # USD names must begin with a letter.
        path = f"{ROOM}/{Tf.MakeValidIdentifier(f'object_{node}')}"
        frame = UsdGeom.Xform.Define(stage, path)
        frame.AddTranslateOp().Set(Gf.Vec3d(*item.center_m))
        prim = frame.GetPrim()
        label = prim.CreateAttribute("userProperties:class", Sdf.ValueTypeNames.String)
        label.Set(item.label)
        _define_mesh(stage, f"{path}/shape", mesh, color, item.center_m)
        if not physics:
            continue
        if not is_fixed(item):
            UsdPhysics.RigidBodyAPI.Apply(prim)
        UsdPhysics.MassAPI.Apply(prim).CreateMassAttr(mass_kg(item))
        for number, body in enumerate(colliders(item)):
            _define_collider(stage, f"{path}/collider_{number}", body, item.center_m)
    for node, mesh in shell.items():
        drawn = _define_mesh(stage, f"{ROOM}/{node}", mesh, shell_color(node), (0.0, 0.0, 0.0))
        if physics:
            UsdPhysics.CollisionAPI.Apply(drawn)
            UsdPhysics.MeshCollisionAPI.Apply(drawn).CreateApproximationAttr(UsdPhysics.Tokens.none)
    return str(stage.GetRootLayer().ExportToString())


def _define_mesh(
    stage: Any,
    path: str,
    mesh: Mesh,
    color: np.ndarray | None,
    origin_m: tuple[float, float, float],
) -> Any:
    """A mesh prim, relative to `origin_m`; without a colour, it is not drawn."""
    from pxr import Gf, UsdGeom, Vt

    prim = UsdGeom.Mesh.Define(stage, path)
    vertices = np.ascontiguousarray(mesh.vertices_m - np.array(origin_m), dtype=np.float32)
    faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([vertices.min(0), vertices.max(0)])))
    if color is not None:
        prim.CreateDisplayColorAttr([Gf.Vec3f(*linear_rgba(color)[:3])])
    return prim.GetPrim()


def _define_collider(
    stage: Any, path: str, body: Solid | Mesh, origin_m: tuple[float, float, float]
) -> None:
    """A cube, an upright cylinder or a convex hull that collides and is not drawn."""
    from pxr import Gf, UsdGeom, UsdPhysics

    size = np.ptp(np.array(body[1:]), axis=0) if isinstance(body, Solid) else np.zeros(3)
    round_ = abs(size[0] - size[2]) <= 1e-3 * size[0]
    if isinstance(body, Solid) and (body.kind == "box" or (body.kind == "cylinder" and round_)):
        if body.kind == "box":
            shape = UsdGeom.Cube.Define(stage, path)
            shape.CreateSizeAttr(1.0)
            shape.CreateExtentAttr([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
        else:
            shape = UsdGeom.Cylinder.Define(stage, path)
            radius, height = float(size[0] / 2), float(size[1])
            shape.CreateAxisAttr(UsdGeom.Tokens.y)
            shape.CreateRadiusAttr(radius)
            shape.CreateHeightAttr(height)
            corner = (radius, height / 2, radius)
            shape.CreateExtentAttr([tuple(-x for x in corner), corner])
        middle = np.mean(np.array(body[1:]), axis=0) - np.array(origin_m)
        shape.AddTranslateOp().Set(Gf.Vec3d(*middle.tolist()))
        if body.kind == "box":
            shape.AddScaleOp().Set(Gf.Vec3f(*size.tolist()))
        prim = shape.GetPrim()
    else:
        prim = _define_mesh(stage, path, mesh_of(body), None, origin_m)
        hull = UsdPhysics.MeshCollisionAPI.Apply(prim)
        hull.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
    UsdPhysics.CollisionAPI.Apply(prim)
    UsdGeom.Imageable(prim).CreatePurposeAttr(UsdGeom.Tokens.guide)


TIMESTEP_S = 0.001
TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from the room frame (y up) to MuJoCo's axes (z up), for column vectors."""
WALL_OPACITY = 0.35
ROUND = 1e-3
"""Relative difference of a cylinder's widths up to which it counts as circular."""


def scene_to_mjcf(scene: Scene, shell: Shell | None = None) -> str:
    """The scene as the text of an MJCF file that needs no other files.

    Each object is a body at the centre of its box, named `<index>_<class>`, with a free joint
    unless it hangs (`is_fixed`). Its solids become geoms: boxes, cylinders and ellipsoids; domes,
    bowls and cylinders with an oval plan become meshes. The mass is that of `mass_kg`, divided
    among the geoms in proportion to their volumes. The floor is an infinite plane; the walls of
    `shell` are boxes around its doors and windows, half transparent, without a ceiling.
    """
    root = Element("mujoco", model=scene.name)
    SubElement(root, "compiler", angle="radian", autolimits="true")
    SubElement(root, "option", timestep=f"{TIMESTEP_S}", cone="elliptic", impratio="10")
    assets, world = SubElement(root, "asset"), SubElement(root, "worldbody")
    SubElement(world, "light", pos="0 0 6", dir="0 0 -1", diffuse="0.8 0.8 0.8")
    floor_color = _numbers(np.append(np.array(FLOOR_COLOR) / 255, 1))
    SubElement(world, "geom", name="floor", type="plane", size="20 20 0.1", rgba=floor_color)
    for node, item, color in zip(
        node_names(scene), scene.objects, object_colors(scene), strict=True
    ):
        center = np.asarray(item.center_m)
        body = SubElement(world, "body", name=node, pos=_numbers(TO_Z_UP @ center))
        if not is_fixed(item):
            SubElement(body, "freejoint")
        bodies = colliders(item)
        volumes = np.array([volume_and_centroid(each)[0] for each in bodies])
        masses = mass_kg(item) * volumes / volumes.sum()
        rgba = _numbers(np.append(color / 255, 1))
        for number, (each, mass) in enumerate(zip(bodies, masses, strict=True)):
            name = f"{node}_{number}"
            shape = _shape(each, center, assets, name)
            SubElement(body, "geom", shape, name=name, mass=f"{mass:.6g}", rgba=rgba)
    for row, wall in enumerate(shell.walls if shell else ()):
        height_m = shell.height_m if shell else 0.0
        for number, (center, half) in enumerate(boxes_of_wall(wall, height_m)):
            yaw = np.arctan2(-wall.direction[1], wall.direction[0])
            SubElement(
                world, "geom", name=f"wall_{row}_{number}", type="box", size=_numbers(half),
                pos=_numbers(TO_Z_UP @ center), axisangle=_numbers(np.array([0, 0, 1, yaw])),
                rgba=_numbers(np.append(np.array(WALL_COLOR) / 255, WALL_OPACITY)),
            )  # fmt: skip
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def boxes_of_wall(
    wall: Wall, height_m: float
) -> Iterator[tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]]:
    """Centres, in the room frame, and half extents (along the wall, thickness, height) of boxes
    that fill a wall beside, below and above its openings, from its start to its end."""
    cuts = sorted({0.0, wall.length_m, *(x for o in wall.openings for x in o[:2])})
    for left, right in itertools.pairwise(cuts):
        middle = (left + right) / 2
        free = [(0.0, height_m)]
        for start, end, bottom, top in wall.openings:
            if start < middle < end:
                free = [
                    part
                    for low, high in free
                    for part in ((low, min(high, bottom)), (max(low, top), high))
                    if part[1] - part[0] > 1e-6
                ]
        for low, high in free:
            x, z = wall.start_m + wall.direction * middle + wall.outward * THICK_M / 2
            half = np.array([right - left, THICK_M, high - low]) / 2
            yield np.array([x, (low + high) / 2, z]), half


def _shape(
    body: Solid | Mesh, origin_m: Float[np.ndarray, "3"], assets: Element, name: str
) -> dict[str, str]:
    """Attributes of the geom of a body, at positions relative to `origin_m`."""
    if isinstance(body, Solid):
        low, high = np.array(body.low_m), np.array(body.high_m)
        half = (high - low) / 2
        at = {"pos": _numbers(TO_Z_UP @ ((low + high) / 2 - origin_m))}
        match body.kind:
            case "box" | "ellipsoid":
                return {**at, "type": body.kind, "size": _numbers(half[[0, 2, 1]])}
            case "cylinder" if abs(half[0] - half[2]) <= ROUND * half[0]:
                return {**at, "type": "cylinder", "size": _numbers(half[:2])}
    vertices = (points_of(body) - origin_m) @ TO_Z_UP.T
    SubElement(assets, "mesh", name=name, vertex=_numbers(vertices.ravel()))
    return {"type": "mesh", "mesh": name}


def _numbers(values: Float[np.ndarray, " numbers"]) -> str:
    return " ".join(f"{value:.6g}" for value in values)
