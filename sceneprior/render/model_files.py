"""GLBs and OBJs with their materials, as parts that have one material each."""

import io
import json
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.checked import shown
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_bytes
from sceneprior.core.furniture import obj_text
from sceneprior.core.scene import Mesh, Textured, join_meshes, mesh_of_file
from sceneprior.render.appearance import linear_rgba

LARGEST_PX = 1024
"""Longest side of a texture; larger ones are scaled down, so that the files of rooms stay small."""
TEXTURES = (
    "baseColorTexture", "emissiveTexture", "normalTexture", "occlusionTexture",
    "metallicRoughnessTexture",
)  # fmt: skip
"""The images of a material."""


def load_parts(
    path: Path, file_type: str | None = None, with_materials: bool = True
) -> dict[str, Textured]:
    """The meshes of a GLB or an OBJ by node name, with the transforms of their nodes applied.

    A damaged file may raise any exception. A GLB that needs an extension that is not read here,
    such as Draco's compression, raises an `InputError`; so does, with materials, an image that
    cannot be read.

    Args:
        file_type: Format of the file; None uses its suffix.
    """
    import trimesh
    from PIL import Image

    content, kind = read_bytes(path), file_type or Path(path).suffix.lower().removeprefix(".")
    if kind == "obj":
        content = obj_text(path).encode()
    elif content.startswith(b"glTF"):
        content = _plain_glb(content, with_materials)
    lost: list[str] = []

    class Beside(trimesh.resolvers.FilePathResolver):
        """Files beside the model; notes images that cannot be read, which trimesh leaves out."""

        def get(self, name: str) -> bytes:
            try:
                found: bytes = super().get(name)
                if not name.lower().endswith((".mtl", ".bin")):
                    Image.open(io.BytesIO(found))
            except Exception:
                lost.extend([] if name.lower().endswith(".mtl") else [name])
                raise
            return found

    # process=False keeps vertices and faces as written.
    loaded = trimesh.load_scene(
        io.BytesIO(content), file_type=kind, process=False, skip_materials=not with_materials,
        resolver=Beside(str(path)),
    )  # fmt: skip
    if lost:
        raise InputError(f"its file {shown(lost[0])} is missing, or no PNG, JPEG or WebP")
    parts = {}
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        mesh = loaded.geometry[name]
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        placed = mesh_of_file(vertices @ transform[:3, :3].T + transform[:3, 3], mesh.faces)
        parts[node] = Textured(placed, *(_surface(mesh.visual) if with_materials else ()))
    return parts


_READ = ("EXT_texture_webp", "KHR_lights_punctual", "KHR_materials_", "KHR_mesh_quantization")
"""Beginnings of the names of extensions that a GLB may require."""
_PREFIX = struct.Struct("<4sIIII")
_WHOLE = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def _plain_glb(content: bytes, with_materials: bool) -> bytes:
    """A GLB whose normalized whole numbers are floats, since trimesh takes them as they are."""
    _, version, _, length, _ = _PREFIX.unpack_from(content)
    start = _PREFIX.size
    data = json.loads(content[start : start + length])
    needed = data.get("extensionsRequired", [])
    if unknown := [name for name in needed if not str(name).startswith(_READ)]:
        raise InputError(
            f"it needs {shown(unknown[0])}, which is not read here; export it again as a plain "
            "GLB, without compressed meshes or textures."
        )
    if with_materials:
        _check_images(data, content[start + length + 8 :])
    chosen = {
        attributes[name]
        for mesh in data.get("meshes", [])
        for primitive in mesh["primitives"]
        for attributes in [primitive["attributes"]]
        for name in attributes
        if name == "POSITION" or name.startswith("TEXCOORD")
    }
    accessors = data.get("accessors", [])
    turned = [k for k in sorted(chosen) if accessors[k].get("normalized")]
    if version != 2 or not turned:
        return content
    packed = bytearray(content[start + length + 8 :])
    for accessor in (accessors[k] for k in turned):
        view, kind = data["bufferViews"][accessor["bufferView"]], _WHOLE[accessor["componentType"]]
        width, size = _WIDTH[accessor["type"]], np.dtype(kind).itemsize
        at = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        stride, count = view.get("byteStride", width * size), accessor["count"]
        if at + (count - 1) * stride + width * size > len(packed):
            raise ValueError("an accessor reaches beyond its buffer")
        raw = np.ndarray((count, width), kind, bytes(packed), at, (stride, size))
        values = np.maximum(raw / np.iinfo(kind).max, -1.0).astype("<f4")
        packed += bytes(-len(packed) % 4)
        data["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(packed), "byteLength": values.nbytes}
        )
        packed += values.tobytes()
        accessor.update(bufferView=len(data["bufferViews"]) - 1, byteOffset=0, componentType=5126)
        del accessor["normalized"]
    data["buffers"][0]["byteLength"] = len(packed)
    packed += bytes(-len(packed) % 4)
    text = json.dumps(data).encode()
    text += b" " * (-len(text) % 4)
    whole = start + len(text) + 8 + len(packed)
    return (
        _PREFIX.pack(b"glTF", 2, whole, len(text), 0x4E4F534A)
        + text
        + struct.pack("<I4s", len(packed), b"BIN\0")
        + packed
    )


def _check_images(data: dict[str, Any], packed: bytes) -> None:
    """Raise an `InputError` if an image within a GLB cannot be decoded, such as KTX2."""
    from PIL import Image

    for texture in data.get("textures", []):
        of = texture.get("extensions", {})
        source = of.get("EXT_texture_webp", texture).get("source")
        image = {"mimeType": ", ".join(of)} if source is None else data["images"][source]
        if "uri" in image:
            continue  # trimesh asks for it
        try:
            view = data["bufferViews"][image["bufferView"]]
            at = view.get("byteOffset", 0)
            Image.open(io.BytesIO(packed[at : at + view["byteLength"]]))
        except (OSError, KeyError):
            raise InputError(
                f"an image of type {shown(image.get('mimeType'))} cannot be decoded; export it "
                "again with images as PNG or JPEG"
            ) from None


def joined(parts: Iterable[Textured]) -> Mesh:
    """Join parts into one closed mesh. Files repeat vertices along the seams of textures, which
    opens closed meshes, so such vertices are merged."""
    return _without_seams(join_meshes([_without_seams(part.mesh) for part in parts]))


def _without_seams(mesh: Mesh) -> Mesh:
    """Merge equal vertices of edges that have only one face. Other equal vertices stay separate,
    since they may belong to closed solids that touch."""
    faces = np.asarray(mesh.faces)
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    edges, sharing = np.unique(edges, axis=0, return_counts=True)
    on_seam = np.unique(edges[sharing == 1])
    _, first, same = np.unique(
        mesh.vertices_m[on_seam], axis=0, return_index=True, return_inverse=True
    )
    merged = np.arange(len(mesh.vertices_m))
    merged[on_seam] = on_seam[first[same.reshape(-1)]]
    used, merged_faces = np.unique(merged[faces], return_inverse=True)
    return Mesh(mesh.vertices_m[used], merged_faces.reshape(-1, 3))


def _surface(visual: Any) -> tuple[Any, np.ndarray | None]:
    """Material of a trimesh visual, and its texture coordinates if it has images; (None, None) if
    the file defines no material."""
    from trimesh.visual.material import PBRMaterial, SimpleMaterial

    material = getattr(visual, "material", None)
    if isinstance(material, SimpleMaterial):
        image, color = material.image, material.kwargs.get("kd")
        # Where an OBJ names no material, trimesh invents one with an image of 2 x 2 pixels.
        image = image if image is not None and max(image.size) > 2 else None
        if color is None and image is None:
            return None, None
        kd = np.full(3, 1.0) if color is None else np.clip(np.asarray(color, dtype=float), 0, 1)
        material = PBRMaterial(
            name=material.name, baseColorTexture=image, metallicFactor=0.0, roughnessFactor=0.9,
            baseColorFactor=linear_rgba(np.round(255 * kd).astype(np.uint8)), doubleSided=True,
        )  # fmt: skip
    if not isinstance(material, PBRMaterial):
        return None, None
    uv = None if visual.uv is None else np.asarray(visual.uv, dtype=np.float64)
    if uv is not None and not np.isfinite(uv).all():
        uv = None
    images = {name: getattr(material, name) for name in TEXTURES}
    shown = {name: image for name, image in images.items() if image is not None and uv is not None}
    for name in images:
        setattr(material, name, _small(shown[name]) if name in shown else None)
    return material, uv if shown else None


def _small(image: Any) -> Any:
    """A texture with at most `LARGEST_PX` pixels along each side, in a colour mode of PNG."""
    image.load()  # read now, so that a damaged image raises here, not when a room is written
    if image.mode not in ("L", "RGB", "RGBA"):
        image = image.convert("RGBA" if "transparency" in image.info else "RGB")
    if max(image.size) > LARGEST_PX:
        image = image.copy()
        image.thumbnail((LARGEST_PX, LARGEST_PX))
    return image
