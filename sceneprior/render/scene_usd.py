"""Scenes as USD: y up, metres, kilograms; rigid bodies for simulators if asked for."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from sceneprior.core.colliders import colliders, is_fixed, mass_kg, mesh_of
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Mesh, Scene, Solid
from sceneprior.render.appearance import (
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
