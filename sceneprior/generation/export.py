"""Write scenes to files (JSON, GLB, PNG), one or a folder of them, and read them back."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from rich.console import Console
from rich.progress import Progress
from torch import Tensor

from sceneprior.errors import InputError
from sceneprior.evaluation.topdown import object_colors, perspective, scene_meshes, topdown
from sceneprior.files import write_json, write_whole
from sceneprior.generation.sample import LATENTS_FILE, write_latents
from sceneprior.offscreen import Renderer
from sceneprior.pictures import contact_sheet, png_bytes
from sceneprior.scene import FORMAT, Mesh, Scene, read_scene, scene_to_json

OVERVIEW_ROOMS = 12
OVERVIEW_TILE = (240, 320)
"""Height and width of one room of the overview, in pixels."""


def write_scene(scene: Scene, folder: Path, name: str, renderer: Renderer) -> None:
    """Write `<name>.glb`, `<name>.png` and `<name>.json`, each whole or not at all.

    The JSON comes last: where it lies, the other two lie beside it. Axes and unit of the GLB
    are the room frame's (y up, metres); it holds one node per object, called
    `<index>_<class>`, in the class colour. An object without a mesh is written as its box.
    The PNG looks straight down; it is what scores compare, with borders between objects.

    Raises:
        InputError: `name` is empty or holds a path separator.
    """
    if not name or Path(name).name != name:
        raise InputError(f"'{name}' cannot name a scene's files; use a plain name such as room_0.")
    folder = Path(folder)
    write_whole(folder / f"{name}.glb", scene_to_glb(scene))
    write_whole(folder / f"{name}.png", png_bytes(topdown(scene, renderer, outlines=True)))
    write_json(folder / f"{name}.json", scene_to_json(scene))


def check_free(folder: Path, overwrite: bool = False) -> None:
    """Refuse a folder in which something would be written over unasked.

    Raises:
        InputError: it is a file, or holds something and `overwrite` is false.
    """
    folder = Path(folder)
    if folder.is_file():
        raise InputError(f"{folder} is a file; name a folder.")
    if not overwrite and folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"{folder} is not empty; add --overwrite or name another folder.")


def clear_scenes(folder: Path) -> None:
    """Delete the scenes that a folder holds, with their GLBs, PNGs and latents, and nothing else:
    the next reader would take them for new ones."""
    for path in Path(folder).glob("*.json"):
        if _format_of(path) == FORMAT:
            for ending in (".glb", ".png", ".json"):
                path.with_suffix(ending).unlink(missing_ok=True)
    (Path(folder) / LATENTS_FILE).unlink(missing_ok=True)


def write_scenes(
    scenes: Sequence[Scene],
    folder: Path,
    renderer: Renderer,
    overwrite: bool = False,
    latents: Float[Tensor, "rooms dimension"] | None = None,
) -> None:
    """Write scenes to a folder (see `check_free`), each under its own name, `overview.png` of the
    first few, and `latents.npz` where latents are given.

    Raises:
        InputError: the folder holds something and `overwrite` is false.
    """
    check_free(folder, overwrite)
    clear_scenes(folder)
    with Progress(console=Console(stderr=True)) as progress:
        for scene in progress.track(scenes, description="Writing scenes"):
            write_scene(scene, folder, scene.name, renderer)
    sheet = overview(scenes[:OVERVIEW_ROOMS], renderer)
    write_whole(Path(folder) / "overview.png", png_bytes(sheet))
    if latents is not None:
        write_latents(folder, latents, [scene.name for scene in scenes])


def overview(scenes: Sequence[Scene], renderer: Renderer) -> UInt8[np.ndarray, "height width 3"]:
    """Rooms (at least one) seen from above a corner, in rows of four, coloured by class."""
    tiles = [perspective(scene, renderer, OVERVIEW_TILE) for scene in scenes]
    return contact_sheet(tiles, min(4, len(tiles)))


def scene_to_glb(scene: Scene) -> bytes:
    """The scene as binary glTF 2.0: a named node, mesh and material per object; no cameras."""
    import trimesh
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    if not scene.objects:
        return _empty_glb()
    room = trimesh.Scene(base_frame="room")
    meshes, colors = scene_meshes(scene), object_colors(scene)
    for node, item, mesh, color in zip(_nodes(scene), scene.objects, meshes, colors, strict=True):
        material = PBRMaterial(
            name=item.label,
            baseColorFactor=_linear_rgba(color),
            metallicFactor=0.0,
            roughnessFactor=0.9,
            # A learned mesh may fold over itself; its back should not be a hole.
            doubleSided=True,
        )
        surface = trimesh.Trimesh(
            np.asarray(mesh.vertices_m, dtype=np.float64),
            np.asarray(mesh.faces, dtype=np.int64),
            process=False,
            visual=TextureVisuals(material=material),
        )
        room.add_geometry(surface, node_name=node, geom_name=node)
    # Without normals viewers shade each triangle flat: boxes keep their edges.
    return bytes(room.export(file_type="glb", include_normals=False))


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
    scenes = [load_scene(path) for path in paths if _format_of(path) in (FORMAT, None)]
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


def _format_of(path: Path) -> str | None:
    """What a JSON says it is; None where it cannot be read."""
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return str(data.get("format", "")) if isinstance(data, dict) else ""
