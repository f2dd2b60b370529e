"""Reads a scan's alignment, objects and mesh from its `.txt`, JSON and PLY files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
from pydantic import BaseModel, Field

from data_prep.readers.frames import is_pose, pose_fault
from sceneprior.core.checked import checked
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.scene import Mesh

_M = TypeVar("_M", bound=BaseModel)
_Index = Annotated[int, Field(strict=True, ge=0, lt=2**31)]


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


def read_properties(path: Path) -> dict[str, str]:
    """Read the `key = value` lines of `<scene>.txt`."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise _unreadable(path, error) from None
    pairs = (line.partition("=") for line in lines)
    return {key.strip(): value.strip() for key, equals, value in pairs if equals}


def axis_alignment(path: Path, properties: dict[str, str]) -> np.ndarray:
    """Rigid transform, (4, 4) float64, that aligns the scan's walls with the axes; z is up.

    The identity if the file has none, as for scans of version 1 and test scans.
    """
    if "axisAlignment" not in properties:
        return np.eye(4)
    words = properties["axisAlignment"].split()
    try:
        matrix = np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError:
        raise InputError(
            f"{path}: axisAlignment is {len(words)} words, expected 16 numbers. "
            "Download the scan again."
        ) from None
    if not is_pose(matrix[None])[0]:
        raise InputError(
            f"{path}: axisAlignment is not a rotation with a translation: {pose_fault(matrix)}; "
            "the file is damaged, or an axis was flipped. Download the scan again."
        )
    return matrix


def read_groups(path: Path) -> tuple[list[Group], list[str]]:
    """Read the objects of `<scene>.aggregation.json`, sorted by id, with notes on oddities."""
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
    """Read the segment of each mesh vertex from `<scene>_vh_clean_2...segs.json`: (V,) int64."""
    why = "it assigns the parts of the mesh to objects"
    return np.array(_read_json(_Segmentation, path, why).segIndices, dtype=np.int64)


def read_mesh(path: Path) -> Mesh:
    """Read `<scene>_vh_clean_2.ply` in the scan's frame, z up: vertices float64, metres."""
    from trimesh.exchange.ply import load_ply

    if not path.is_file():
        raise _unreadable(path, FileNotFoundError("no such file"))
    try:
        # Load raw arrays, not a Trimesh, which may merge or drop vertices: segs.json indexes them.
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


def _read_json(model: type[_M], path: Path, why: str) -> _M:
    if not path.is_file():
        raise _unreadable(path, FileNotFoundError("no such file"), why)
    try:
        return checked(model, read_json(path), str(path))
    except InputError as error:
        raise InputError(f"{error} Download the scan again.") from None


def _unreadable(path: Path, error: Exception, why: str = "") -> InputError:
    reason = getattr(error, "strerror", None) or error
    return InputError(
        f"{path} cannot be read ({reason}){'; ' if why else ''}{why}. "
        f"Download it into the scan's folder, or leave {path.parent.name} out of the list of scans."
    )
