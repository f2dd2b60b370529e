"""Scene files: write JSON, GLB, OBJ, USD and PNG; read a scene, or a folder of scenes."""

import json
import re
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.boxes import CUBE_CORNERS, yaw_rotation
from sceneprior.core.errors import InputError, InputWarning
from sceneprior.core.files import is_name, list_files, read_json, write_json, write_whole
from sceneprior.core.scene import Mesh, Scene, SceneObject, Textured
from sceneprior.core.scene_json import FORMAT, read_scene, scene_to_json
from sceneprior.core.shell import ShellName, is_shell, shell_meshes
from sceneprior.render.appearance import (
    linear_rgba,
    node_names,
    object_colors,
    png_bytes,
    scene_meshes,
    shell_color,
)
from sceneprior.render.model_files import joined, load_parts
from sceneprior.render.scene_simulators import scene_to_usd

NO_SHELL: Mapping[str, Mesh] = {}
ROUNDED_M = 1e-4
"""Distance by which the corners of a box differ between a GLB and a JSON, which round."""
PACKAGE_FORMATS = "sceneprior-"
"""Prefix of the names of the package's formats."""


def save(scene: Scene, path: Path | str, shell: ShellName = "none") -> None:
    """Write a scene to one file, atomically, in the format of its suffix.

    `.json`: classes and boxes. `.glb`: one node per object, called `<index>_<class>`, in the class
    colour or with the materials of its CAD model, in children `<index>_<class>/<number>`; an object
    without a mesh is written as its box. `.obj`: the objects in class colours, with an `.mtl` file.
    `.usda`: one mesh per object, its class in `userProperties:class`. `.png`: a floor plan
    of the whole room. 3D formats keep the axes and the unit of the room frame: y up, metres.

    Args:
        shell: With `walls`, 3D files also have nodes `floor`, `wall_0` and so on, and `ceiling`;
            with `floor`, only the node `floor`.

    Raises:
        InputError: the path has another suffix.

    Example:

        >>> from tempfile import TemporaryDirectory
        >>> from sceneprior.core.scene import SceneObject
        >>> bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (1.8, 0.6, 2.0))
        >>> with TemporaryDirectory() as folder:
        ...     save(Scene("mine", "front3d_bedroom", (bed,)), f"{folder}/mine.glb")
        ...     Path(f"{folder}/mine.glb").read_bytes()[:4]
        b'glTF'
    """
    path = Path(path)
    match path.suffix:
        case ".json":
            write_json(path, scene_to_json(scene))
        case ".glb":
            write_whole(path, scene_to_glb(scene, shell_meshes(scene, shell)))
        case ".obj":
            materials = path.with_suffix(".mtl")
            text, described = scene_to_obj(scene, materials.name, shell_meshes(scene, shell))
            write_whole(materials, described)
            write_whole(path, text)
        case ".usda":
            write_whole(path, scene_to_usd(scene, shell_meshes(scene, shell)))
        case ".png":
            # Imported here, since models need no z-buffer.
            from sceneprior.render.topdown import floor_plan

            # Flat colours: runs alone are 8% larger than all repeats, in two thirds of the time.
            write_whole(path, png_bytes(floor_plan(scene), compress_type=zlib.Z_RLE))
        case suffix:
            raise InputError(
                f"{path} ends with '{suffix}', which is not a scene format; end it with one of "
                ".json, .glb, .obj, .usda, .png."
            )


def scene_to_glb(scene: Scene, shell: Mapping[str, Mesh] = NO_SHELL) -> bytes:
    """The scene as binary glTF 2.0: a named node, mesh and material per object, or a node with a
    child per material if the object is textured; no cameras.

    The `extras` of its glTF scene have the entry `sceneprior` with name, label set, `extra`, and
    each object's node and class, with its yaw where known (docs/conventions.md).

    Args:
        shell: Meshes of the room by the names of their nodes (`core/shell.py`).
    """
    objects = [
        {"node": node, "class": item.label, **item.facing}
        for node, item in zip(node_names(scene), scene.objects, strict=True)
    ]
    told = {"name": scene.name, "label_set": scene.label_set, "extra": scene.extra}
    extras = {"sceneprior": {**told, "objects": objects}}
    if scene.objects or shell:
        room = _trimesh_of(scene, shell)
        room.metadata.update(extras)
        # Without normals, viewers use flat shading, and boxes keep sharp edges.
        return bytes(room.export(file_type="glb", include_normals=False))
    # trimesh does not export a scene without geometry, but an empty room is valid.
    scenes = [{"extras": extras}]
    text = json.dumps({"asset": {"version": "2.0"}, "scene": 0, "scenes": scenes}).encode()
    text += b" " * (-len(text) % 4)
    header = np.array([0x46546C67, 2, 20 + len(text), len(text), 0x4E4F534A], dtype="<u4")
    return header.tobytes() + text


def scene_to_obj(
    scene: Scene, materials: str, shell: Mapping[str, Mesh] = NO_SHELL
) -> tuple[str, bytes]:
    """The scene as a Wavefront OBJ, with one named object per piece of furniture, and as its MTL.

    The OBJ refers to the MTL file by the name `materials`. y is up, in metres, as in the GLB.
    """
    from trimesh.exchange.obj import export_obj

    if not scene.objects and not shell:
        return "", b""
    plain = tuple(replace(item, textured=()) for item in scene.objects)
    text, files = export_obj(
        _trimesh_of(replace(scene, objects=plain), shell, rgba=lambda srgb: [*srgb, 255]),
        include_normals=False, return_texture=True, mtl_name=materials, header=None,
    )  # fmt: skip
    return text + "\n", files[materials]


def _trimesh_of(scene: Scene, shell: Mapping[str, Mesh], rgba: Any = linear_rgba) -> Any:
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    room = trimesh.Scene(base_frame="room")

    def add(
        node: str, label: str, part: Textured, color: np.ndarray, parent: str | None = None
    ) -> None:
        surface = part.material or PBRMaterial(
            name=label,
            baseColorFactor=rgba(color),
            metallicFactor=0.0,
            roughnessFactor=0.9,
            # A learned mesh may fold over itself, so its back faces are drawn. Walls are closed, or
            # should be invisible from behind.
            doubleSided=not is_shell(node),
        )
        geometry = trimesh.Trimesh(
            np.asarray(part.mesh.vertices_m, dtype=np.float64),
            np.asarray(part.mesh.faces, dtype=np.int64),
            process=False,
            visual=TextureVisuals(uv=part.uv, material=surface),
        )
        room.add_geometry(geometry, node_name=node, geom_name=node, parent_node_name=parent)

    meshes, colors = scene_meshes(scene), object_colors(scene)
    for node, item, mesh, color in zip(
        node_names(scene), scene.objects, meshes, colors, strict=True
    ):
        if not item.textured:
            add(node, item.label, Textured(mesh), color)
            continue
        room.graph.update(frame_from=room.graph.base_frame, frame_to=node)
        for number, part in enumerate(item.textured):
            add(f"{node}/{number}", item.label, part, color, node)
    for node, mesh in shell.items():
        add(node, node.partition("_")[0], Textured(mesh), shell_color(node))
    return room


def read_glb_parts(path: Path, with_materials: bool = False) -> dict[str, list[Textured]]:
    """The parts of each object of a GLB by the name of its node, without the room's shell; vertices
    in the room frame."""
    objects: dict[str, list[Textured]] = {}
    try:
        for node, part in load_parts(path, "glb", with_materials).items():
            name, child, _ = node.partition("/")
            if not is_shell(node):
                # A node without children has the colour of its class.
                objects.setdefault(name, []).append(part if child else Textured(part.mesh))
    except Exception as error:  # a damaged file raises almost anything in trimesh
        reason = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
        raise InputError(
            f"{path} cannot be read as a GLB ({reason.rstrip('.')}); write the scene again with "
            "`sceneprior synthesize`, or delete the file to use the boxes alone."
        ) from None
    return objects


def load_scene(path: Path, with_materials: bool = False) -> Scene:
    """Read a scene's JSON, and its meshes from the GLB of the same name if there is one.

    Args:
        with_materials: Also read the materials of CAD models (`SceneObject.textured`), which take
            much more memory than their meshes.

    Raises:
        InputError: the JSON is not a scene, or the GLB has other objects.
    """
    path = Path(path)
    scene = read_scene(path)
    glb = path.with_suffix(".glb")
    if not glb.is_file() or not scene.objects:
        return scene
    parts = read_glb_parts(glb, with_materials)
    wanted = node_names(scene)
    if set(parts) != set(wanted):
        unlisted = sorted(set(parts) ^ set(wanted))
        raise InputError(
            f"{glb.name} and {path.name} describe different objects (only in one of them: "
            f"{', '.join(unlisted[:4])}); write both again with `sceneprior synthesize`."
        )
    pairs = zip(scene.objects, (parts[node] for node in wanted), strict=True)
    return replace(scene, objects=tuple(_with_mesh(item, found) for item, found in pairs))


def _with_mesh(item: SceneObject, parts: Sequence[Textured]) -> SceneObject:
    """The object with the parts of its mesh. If the mesh is only its box, which files have in place
    of no mesh, the object stays without one; if it is the turned box, that is its solid, too."""
    mesh = parts[0].mesh if len(parts) == 1 else joined(parts)
    textured = tuple(part for part in parts if part.material is not None)
    if textured or len(mesh.vertices_m) != len(CUBE_CORNERS):
        return replace(item, mesh=mesh, textured=textured)

    def fits(size_m: Sequence[float], yaw_rad: float) -> bool:
        own_m = CUBE_CORNERS / 2 * size_m @ yaw_rotation(yaw_rad).T + item.center_m
        return np.allclose(mesh.vertices_m, own_m, rtol=0, atol=ROUNDED_M)

    if fits(item.size_m, 0.0):
        return item
    is_turned = item.turned is not None and fits(item.turned.size_m, item.turned.yaw_rad)
    return replace(item, mesh=mesh, solids=item.solids or (mesh,) * is_turned)


def load_scene_folder(folder: Path, with_materials: bool = False) -> list[Scene]:
    """Read all scenes of a folder, sorted by name in natural order (room_2 before room_10), each as
    `load_scene` does.

    JSON files of the package's other formats, such as scores, are skipped; JSON files of unknown
    formats are skipped with a warning.
    """
    folder = Path(folder)
    if not folder.is_dir():
        _refuse_box_lists(folder, [folder])
        if folder.is_file():
            raise InputError(f"{folder} is a file; give the folder of scenes, {folder.parent}.")
        raise InputError(f"No folder of scenes at {folder}; `sceneprior synthesize` writes one.")
    # Zero-padded numbers sort like numbers.
    paths = sorted(
        list_files(folder, "*.json"),
        key=lambda path: [
            part.zfill(20) if part.isdigit() else part for part in re.split(r"(\d+)", path.stem)
        ],
    )
    # Unreadable files (format None) are not skipped, so that load_scene reports their error.
    formats = {path: format_of(path) for path in paths}
    scenes = [
        load_scene(path, with_materials) for path, form in formats.items() if form in (FORMAT, None)
    ]
    if not scenes:
        _refuse_box_lists(folder, [*list_files(folder, "*.npz", deep=True), *paths])
        raise InputError(
            f"{folder} holds no scene JSON; `sceneprior synthesize` writes them, and "
            "docs/conventions.md describes the format."
        )
    if other := [
        path.name
        for path, form in formats.items()
        if form is not None and not form.startswith(PACKAGE_FORMATS)
    ]:
        warnings.warn(
            f"{len(scenes)} scenes are read from {folder}; {len(other)} other JSON files there are "
            f"not scenes ('format' is not {FORMAT}) and are skipped: {', '.join(other[:3])}"
            f"{', ...' if len(other) > 3 else ''}.",
            InputWarning,
            stacklevel=2,
        )
    return scenes


def _refuse_box_lists(given: Path, paths: Iterable[Path]) -> None:
    """Raise an `InputError` that names the conversion command if a path is a box list of ATISS."""
    for path in paths:
        try:
            if path.suffix == ".npz":
                with zipfile.ZipFile(path) as file:
                    keys = [name.removesuffix(".npy") for name in file.namelist()]
            else:
                data = read_json(path)
                keys = data[0] if isinstance(data, list) and data else data
        except (OSError, zipfile.BadZipFile, InputError):
            continue
        if isinstance(keys, list | dict) and "class_labels" in keys:
            raise InputError(
                f"{given} holds box lists ({path.name}), not scenes; `sceneprior export {given} "
                "--to scenes --label-set front3d_bedroom --out DIR` converts them, if you give the "
                "label set of their classes."
            )


def check_names(scenes: Sequence[Scene]) -> None:
    """Check that the scenes' names are unique and can be file names."""
    counts = Counter(scene.name for scene in scenes)
    for name, count in counts.items():
        if count > 1:
            raise InputError(
                f"{count} rooms are called '{name}', and files are named after rooms; give each "
                "another `name` in its JSON."
            )
        if not is_name(name):
            raise InputError(
                f"A room is called {ascii(name)[:60]}, which cannot be the name of a file; give it "
                "a short one without slashes (`name` in its JSON)."
            )


def format_of(path: Path) -> str | None:
    """The `format` entry of a JSON file ("" without one); None if the file cannot be read."""
    try:
        data = read_json(path)
    except InputError:
        return None
    return str(data.get("format", "")) if isinstance(data, dict) else ""
