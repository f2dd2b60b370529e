"""GLBs and OBJs with their materials, as parts that have one material each."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.files import check_file
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

    A damaged file may raise any exception.

    Args:
        file_type: Format of the file; None uses its suffix.
    """
    import trimesh

    check_file(path)
    # process=False keeps vertices and faces as written.
    loaded = trimesh.load_scene(
        Path(path), file_type=file_type, process=False, skip_materials=not with_materials
    )
    parts = {}
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        mesh = loaded.geometry[name]
        vertices = np.asarray(mesh.vertices, dtype=np.float64)
        placed = mesh_of_file(vertices @ transform[:3, :3].T + transform[:3, 3], mesh.faces)
        parts[node] = Textured(placed, *(_surface(mesh.visual) if with_materials else ()))
    return parts


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
