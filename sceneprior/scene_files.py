"""Scenes as files: JSON, GLB, OBJ and PNG, one by one; a folder of them read back."""

import json
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.errors import InputError
from sceneprior.files import write_json, write_whole
from sceneprior.offscreen import Renderer, open_renderer
from sceneprior.pictures import png_bytes
from sceneprior.scene import FORMAT, Mesh, Scene, read_scene, scene_to_json
from sceneprior.topdown import FLOOR_COLOR, object_colors, scene_meshes, topdown


def save_scene(scene: Scene, path: Path, renderer: Renderer | None = None) -> None:
    """Write a scene to one file, whole or not at all, in the format that its name ends with.

    `.json`: classes and boxes. `.glb`: one node per object, called `<index>_<class>`, in the class
    colour; an object without a mesh is written as its box. `.obj`: the same, with the `.mtl` beside
    it. `.usda`: a mesh per object, its class in `userProperties:class`. `.png`: straight from
    above, what scores compare, with borders between objects. Axes and unit are the room frame's: y
    up, metres.

    Args:
        renderer: For pictures; None opens one.

    Raises:
        InputError: the name has another ending.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise InputError(
            f"{path} ends with '{path.suffix}', which is no format of scenes; end it with one of "
            f"{', '.join(WRITERS)}."
        )
    WRITERS[path.suffix](scene, path, renderer)


def _write_json(scene: Scene, path: Path, _: Renderer | None) -> None:
    write_json(path, scene_to_json(scene))


def _write_glb(scene: Scene, path: Path, _: Renderer | None) -> None:
    write_whole(path, scene_to_glb(scene))


def _write_obj(scene: Scene, path: Path, _: Renderer | None) -> None:
    materials = path.with_suffix(".mtl")
    text, described = scene_to_obj(scene, materials.name)
    write_whole(materials, described)
    write_whole(path, text)


def _write_png(scene: Scene, path: Path, renderer: Renderer | None) -> None:
    picture = topdown(scene, renderer or open_renderer(), outlines=True)
    write_whole(path, png_bytes(picture))


def _write_usd(scene: Scene, path: Path, _: Renderer | None) -> None:
    write_whole(path, scene_to_usd(scene))


WRITERS: Mapping[str, Callable[[Scene, Path, Renderer | None], None]] = {
    ".json": _write_json, ".glb": _write_glb, ".obj": _write_obj, ".usda": _write_usd,
    ".png": _write_png,
}  # fmt: skip


def scene_to_glb(scene: Scene, floor: Mesh | None = None) -> bytes:
    """The scene as binary glTF 2.0: a named node, mesh and material per object; no cameras.

    Args:
        floor: One node more, `floor`: for pages, since `load_scene` knows no such object.
    """
    if not scene.objects and floor is None:
        return _empty_glb()
    room = _trimesh_of(scene)
    if floor is not None:
        _add(room, "floor", "floor", floor, np.array(FLOOR_COLOR))
    # Without normals viewers shade each triangle flat: boxes keep their edges.
    return bytes(room.export(file_type="glb", include_normals=False))


def scene_to_obj(scene: Scene, materials: str) -> tuple[str, bytes]:
    """The scene as Wavefront OBJ, one named object each, and as the file of that name its
    materials (MTL); y up, in metres, as the GLB."""
    from trimesh.exchange.obj import export_obj

    if not scene.objects:
        return "", b""
    text, files = export_obj(
        _trimesh_of(scene), include_normals=False, return_texture=True, mtl_name=materials,
        header=None,
    )  # fmt: skip
    return text + "\n", files[materials]


def scene_to_usd(scene: Scene) -> str:
    """The scene as the text of a USD stage: y up, metres; `/room` holds a mesh per object.

    Raises:
        InputError: the package `usd-core` is missing.
    """
    try:
        from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt
    except ImportError:
        raise InputError("USD needs a package more: pip install 'sceneprior[usd]'.") from None
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/room").GetPrim())
    meshes, colors = scene_meshes(scene), object_colors(scene)
    for node, item, mesh, color in zip(_nodes(scene), scene.objects, meshes, colors, strict=True):
        # Names of USD begin with a letter.
        prim = UsdGeom.Mesh.Define(
            stage, Sdf.Path("/room").AppendChild(Tf.MakeValidIdentifier(f"object_{node}"))
        )
        vertices = np.ascontiguousarray(mesh.vertices_m, dtype=np.float32)
        faces = np.ascontiguousarray(mesh.faces, dtype=np.int32)
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
        prim.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
        prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.ravel()))
        prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        prim.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([vertices.min(0), vertices.max(0)])))
        prim.CreateDisplayColorAttr([Gf.Vec3f(*_linear_rgba(color)[:3])])
        label = prim.GetPrim().CreateAttribute("userProperties:class", Sdf.ValueTypeNames.String)
        label.Set(item.label)
    return str(stage.GetRootLayer().ExportToString())


def _trimesh_of(scene: Scene) -> Any:
    import trimesh

    room = trimesh.Scene(base_frame="room")
    meshes, colors = scene_meshes(scene), object_colors(scene)
    for node, item, mesh, color in zip(_nodes(scene), scene.objects, meshes, colors, strict=True):
        _add(room, node, item.label, mesh, color)
    return room


def _add(room: Any, node: str, material: str, mesh: Mesh, color: np.ndarray) -> None:
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    surface = PBRMaterial(
        name=material,
        baseColorFactor=_linear_rgba(color),
        metallicFactor=0.0,
        roughnessFactor=0.9,
        # A learned mesh may fold over itself; its back should not be a hole.
        doubleSided=True,
    )
    geometry = trimesh.Trimesh(
        np.asarray(mesh.vertices_m, dtype=np.float64),
        np.asarray(mesh.faces, dtype=np.int64),
        process=False,
        visual=TextureVisuals(material=surface),
    )
    room.add_geometry(geometry, node_name=node, geom_name=node)


def _nodes(scene: Scene) -> list[str]:
    return [f"{index}_{item.label}" for index, item in enumerate(scene.objects)]


def _linear_rgba(color: np.ndarray) -> list[float]:
    # glTF wants base colours in linear light, class colours are sRGB.
    srgb = color / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return [*(float(value) for value in linear), 1.0]


def _empty_glb() -> bytes:
    # trimesh refuses to export a scene without geometry; an empty room is still a room.
    text = json.dumps({"asset": {"version": "2.0"}, "scene": 0, "scenes": [{}]}).encode()
    text += b" " * (-len(text) % 4)
    header = np.array([0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A], dtype="<u4")
    return header.tobytes() + text


def read_glb_meshes(path: Path) -> dict[str, Mesh]:
    """The meshes of a GLB by node name, vertices in the room frame in metres.

    Raises:
        InputError: the file is missing or not a GLB.
    """
    import trimesh

    try:
        # process=False keeps vertices and faces as they were written.
        loaded = trimesh.load_scene(Path(path), file_type="glb", process=False)
        meshes = {}
        for node in loaded.graph.nodes_geometry:
            transform, name = loaded.graph[node]
            mesh = loaded.geometry[name]
            vertices = np.asarray(mesh.vertices, dtype=np.float64)
            placed = vertices @ transform[:3, :3].T + transform[:3, 3]
            meshes[node] = Mesh(placed, np.asarray(mesh.faces))
        return meshes
    except Exception as error:  # what trimesh raises depends on which byte is damaged
        raise InputError(
            f"{path} cannot be read as a GLB ({type(error).__name__}: {error}); write the scene "
            "again with `sceneprior synthesize`, or delete the file to use the boxes alone."
        ) from None


def load_scene(path: Path) -> Scene:
    """A scene's JSON, with the meshes of the GLB of the same name where it lies beside.

    Raises:
        InputError: the JSON is not a scene, or the GLB belongs to another one.
    """
    path = Path(path)
    scene = read_scene(path)
    glb = path.with_suffix(".glb")
    if not glb.is_file() or not scene.objects:
        return scene
    meshes = read_glb_meshes(glb)
    wanted = _nodes(scene)
    if set(meshes) != set(wanted):
        unlisted = sorted(set(meshes) ^ set(wanted))
        raise InputError(
            f"{glb.name} and {path.name} describe different objects (only in one of them: "
            f"{', '.join(unlisted[:4])}); write both again with `sceneprior synthesize`."
        )
    with_mesh = [
        replace(item, mesh=meshes[node]) for node, item in zip(wanted, scene.objects, strict=True)
    ]
    return replace(scene, objects=tuple(with_mesh))


def load_scene_folder(folder: Path) -> list[Scene]:
    """Every scene of a folder, by name with numbers in counting order (room_2 before room_10).

    JSON files of other formats (scores, say) are passed over; a damaged one is an error.

    Raises:
        InputError: the folder is missing, holds no scene, or a file in it is damaged.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"No folder of scenes at {folder}; `sceneprior synthesize` writes one.")
    paths = sorted(folder.glob("*.json"), key=_counting_order)
    # What cannot be read is not passed over: load_scene says what is wrong with it.
    scenes = [load_scene(path) for path in paths if format_of(path) in (FORMAT, None)]
    if not scenes:
        raise InputError(
            f"{folder} holds no scene JSON; `sceneprior synthesize` writes them, and "
            "docs/conventions.md describes the format."
        )
    return scenes


def _counting_order(path: Path) -> list[str]:
    # Numbers padded with zeros compare like numbers.
    parts = re.split(r"(\d+)", path.stem)
    return [part.zfill(20) if part.isdigit() else part for part in parts]


def format_of(path: Path) -> str | None:
    """What a JSON says it is; None where it cannot be read."""
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return str(data.get("format", "")) if isinstance(data, dict) else ""
