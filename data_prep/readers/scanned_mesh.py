"""Annotated meshes of scans (ScanNet, ScanNet++): objects, their surfaces, and what hides them."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from pydantic import BaseModel, Field

from sceneprior.core.cameras import to_camera, to_pixels
from sceneprior.core.checked import checked
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.scene import Mesh
from sceneprior.render.offscreen.zbuffer import NEAR_PLANE_M, rasterize

_M = TypeVar("_M", bound=BaseModel)
_Index = Annotated[int, Field(strict=True, ge=0, lt=2**31)]
_BEHIND_M = 0.05
"""Minimum depth of a vertex behind the rendered surface to count as occluded; smaller depths occur
at borders between objects."""
_CUT_SHARE = 0.005
"""Tolerance of the sides of the 2D box, relative to the image's longer side."""


class _Object(BaseModel):
    objectId: _Index  # noqa: N815
    label: str
    segments: frozenset[_Index]


class _Aggregation(BaseModel):
    segGroups: list[_Object]  # noqa: N815


class _Segmentation(BaseModel):
    segIndices: list[_Index]  # noqa: N815


@dataclass(frozen=True)
class Group:
    """One annotated object: an entry of the aggregation's `segGroups`."""

    object_id: int
    category: str
    segments: frozenset[int]


@dataclass(frozen=True)
class AnnotatedMesh:
    """The mesh of a scan and its annotated objects."""

    mesh: Mesh
    groups: list[Group]
    """Objects, sorted by id."""
    parts: list[np.ndarray]
    """Indices of each object's vertices; empty if the mesh has none of its segments."""
    notes: list[str]

    def points_m(self, k: int) -> np.ndarray:
        """Vertices of object k."""
        return self.mesh.vertices_m[self.parts[k]]


def read_annotated_mesh(
    mesh_path: Path, segments_path: Path, groups_path: Path, world_from_mesh: np.ndarray
) -> AnnotatedMesh:
    """Read the mesh, the segment of each vertex, and the objects, which are sets of segments."""
    mesh = read_mesh(mesh_path)
    groups, notes = read_groups(groups_path)
    segments = read_segments(segments_path)
    if len(segments) != len(mesh.vertices_m):
        raise InputError(
            f"{segments_path} has {len(segments)} segIndices, but {mesh_path.name} "
            f"{len(mesh.vertices_m)} vertices; they are not of one release, or the mesh is "
            "truncated. Download both again."
        )
    return AnnotatedMesh(
        moved(mesh, world_from_mesh), groups, object_parts(groups, segments), notes
    )


def moved(mesh: Mesh, transform: np.ndarray) -> Mesh:
    """The mesh after a rigid transform, (4, 4)."""
    return Mesh(to_camera(mesh.vertices_m, transform), mesh.faces)


def read_groups(path: Path) -> tuple[list[Group], list[str]]:
    """Read the objects of an aggregation, sorted by id, with notes on oddities."""
    why = "a scan without annotations (ScanNet's test scans) cannot be prepared"
    found: dict[int, Group] = {}
    notes = []
    for entry in _read_json(_Aggregation, path, why).segGroups:
        number, category, segments = entry.objectId, entry.label, entry.segments
        if number in found:
            notes.append(f"object {number} is listed twice; its parts were joined")
            category, segments = found[number].category, segments | found[number].segments
        found[number] = Group(number, category, segments)
    return [found[number] for number in sorted(found)], notes


def read_segments(path: Path) -> np.ndarray:
    """Read the segment of each mesh vertex: (V,) int64."""
    why = "it assigns the parts of the mesh to objects"
    return np.array(_read_json(_Segmentation, path, why).segIndices, dtype=np.int64)


def read_mesh(path: Path) -> Mesh:
    """Read a PLY: vertices float64, metres."""
    from trimesh.exchange.ply import load_ply

    if not path.is_file():
        raise unreadable(path, FileNotFoundError("no such file"))
    try:
        # Load raw arrays, not a Trimesh, which may merge or drop vertices: segments index them.
        with path.open("rb") as file:
            loaded = load_ply(file, fix_texture=False, skip_materials=True)
        vertices = np.array(loaded["vertices"], dtype=np.float64).reshape(-1, 3)
        faces = np.array(loaded.get("faces", ()), dtype=np.int64).reshape(-1, 3)
    except Exception as error:  # trimesh raises many types for damaged files
        raise InputError(
            f"{path} is not a mesh that can be read ({type(error).__name__}: {error}); "
            "it is truncated or damaged. Download the scan again."
        ) from None
    if not len(vertices) or not np.isfinite(vertices).all():
        raise InputError(f"{path} holds no vertices, or broken ones. Download the scan again.")
    if faces.size and not (faces.min() >= 0 and faces.max() < len(vertices)):
        raise InputError(f"{path} has triangles of vertices it lacks. Download the scan again.")
    return Mesh(vertices, faces)


def object_parts(groups: list[Group], segments: np.ndarray) -> list[np.ndarray]:
    """Indices of each group's mesh vertices; `segments` (V,) has the segment of each vertex."""
    order = np.argsort(segments, kind="stable")
    numbers, starts = np.unique(segments[order], return_index=True)
    parts = dict(zip(numbers.tolist(), np.split(order, starts[1:]), strict=True))
    nothing = np.zeros(0, dtype=np.int64)
    return [
        np.concatenate([nothing, *(parts[k] for k in sorted(group.segments) if k in parts)])
        for group in groups
    ]


def surface_of(mesh: Mesh, part: np.ndarray) -> Mesh | None:
    """Cut the submesh with the vertices `part` out of a mesh; None if it has no triangles.

    All vertices of the part are kept, even if no triangle uses them, as at borders with other
    objects, so that the surface has the same bounding box as the object.
    """
    part = np.sort(part)
    number = np.full(len(mesh.vertices_m), -1)
    number[part] = np.arange(len(part))
    faces = number[mesh.faces]
    faces = faces[(faces >= 0).all(axis=1)]
    return Mesh(mesh.vertices_m[part], faces) if len(faces) else None


def unoccluded(
    mesh: Mesh,
    parts: list[np.ndarray],
    chosen: Iterable[int],
    world_to_camera: np.ndarray,
    intrinsics: np.ndarray,
    image_size: tuple[int, int],
) -> np.ndarray:
    """Find the views that show each chosen object without occlusion, (views, len(chosen)) bool.

    The 2D box of its visible vertices is compared with the 2D box of all its vertices. Everything
    in the mesh occludes: walls, doors, objects, unannotated surfaces. `parts` are the vertices of
    each object; indices from `len(parts)` on are never unoccluded. `intrinsics` is (3, 3).
    """
    height, width = image_size
    projection = focal_and_center(intrinsics)
    slack = _CUT_SHARE * max(height, width)
    chosen = list(chosen)
    whole = np.zeros((len(world_to_camera), len(chosen)), dtype=bool)
    owner = np.full(len(mesh.vertices_m) + 1, -1)
    for k, part in enumerate(parts):
        owner[part] = k
    # The last row is for pixels that show no surface.
    owners = np.concatenate([owner[mesh.faces], [[-1, -1, -1]]])
    for view, camera in enumerate(world_to_camera):
        index, nearest = rasterize(mesh.vertices_m, mesh.faces, camera, projection, image_size)
        for column, k in enumerate(chosen):
            if k >= len(parts):
                continue
            points = to_camera(mesh.vertices_m[parts[k]], camera)
            depth = points[:, 2]
            if (depth <= NEAR_PLANE_M).any():
                continue
            pixels = to_pixels(points, intrinsics)
            columns, rows = np.floor(np.clip(pixels, -1, max(height, width))).astype(np.int64).T
            seen = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
            at = rows[seen], columns[seen]
            hidden = (nearest[at] < depth[seen] - _BEHIND_M) & (owners[index[at]] != k).all(axis=1)
            seen[seen] = ~hidden
            if seen.any():
                ends = [np.stack([ends.min(axis=0), ends.max(axis=0)])
                        for ends in (pixels, pixels[seen])]  # fmt: skip
                whole[view, column] = np.abs(ends[0] - ends[1]).max() <= slack
    return whole


def focal_and_center(K: np.ndarray) -> tuple[float, float, float, float]:
    """Focal lengths and principal point of intrinsics, (3, 3), as `rasterize` takes them."""
    return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])


def _read_json(model: type[_M], path: Path, why: str) -> _M:
    if not path.is_file():
        raise unreadable(path, FileNotFoundError("no such file"), why)
    try:
        return checked(model, read_json(path), str(path))
    except InputError as error:
        raise InputError(f"{error} Download the scan again.") from None


def unreadable(path: Path, error: Exception, why: str = "") -> InputError:
    """Error of a scan's file that is missing or cannot be read."""
    reason = getattr(error, "strerror", None) or error
    return InputError(
        f"{path} cannot be read ({reason}){'; ' if why else ''}{why}. "
        f"Download it into the scan's folder, or leave {path.parent.name} out of the list of scans."
    )
