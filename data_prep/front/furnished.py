"""Furniture models of 3D-FUTURE in metres, and rooms that are furnished with them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from cachetools import LRUCache, cachedmethod

from sceneprior.core.files import file_stamp, is_name
from sceneprior.core.furniture import MODEL_FILE, model_categories, read_obj
from sceneprior.core.scene import Mesh

_FLAT_M = 1e-3
_NO_FURNITURE_M = 10.0
"""Longest plausible side of a model; nearly all models in centimetres exceed it."""
_OVERSIZED = (50.0, 200.0)
"""Range of the ratio between a mesh's longest side and the house's statement, for centimetres."""
_CACHE_BYTES = 512 * 2**20
"""Size of a process's mesh cache: about two thousand models of 3D-FUTURE's usual size."""


@dataclass(frozen=True)
class Furniture:
    """One piece of furniture with its pose in the room."""

    label: str
    """Class in the recipe's label set; `void` for a category without a class."""
    category: str
    """Category in the data set, in lower case."""
    model_id: str
    model: Mesh
    """The model in its own frame (metres, y up, front +z), shared by all its copies."""
    model_to_room: np.ndarray
    """(4, 4) float64: scale (negative if mirrored), rotation, translation."""

    @property
    def mesh(self) -> Mesh:
        """Mesh in the room frame; a mirrored piece has its faces flipped, to point outwards."""
        linear, place = self.model_to_room[:3, :3], self.model_to_room[:3, 3]
        faces = self.model.faces
        if np.linalg.det(linear) < 0:
            faces = faces[:, ::-1]
        return Mesh(self.model.vertices_m @ linear.T + place, faces)

    @property
    def yaw_rad(self) -> float:
        """Rotation about +y that takes +z to the piece's front."""
        front = self.model_to_room[:3, 2]
        return float(np.arctan2(front[0], front[2]))


@dataclass(frozen=True)
class Room:
    """A furnished room: y up, floor at y = 0, origin at the centre of the floor's bounding box."""

    room_id: str
    """`<house>_<instanceid>`."""
    type: str
    floor: shapely.Polygon | shapely.MultiPolygon
    """Floor plan in x and z, metres."""
    height_m: float
    furniture: tuple[Furniture, ...]
    notes: tuple[str, ...] = ()
    """Parts of the room that were left out, with reasons."""
    without_model: tuple[tuple[str, str], ...] = ()
    """Model id and category of each piece that is left out for lack of a model."""
    shell: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Triangles, (F, 3, 3), of the room itself by their class in `STUFF`, in the room frame."""

    @property
    def floor_outline_m(self) -> np.ndarray:
        """Outline of the floor's largest part: (P, 2) in x and z, first point not repeated."""
        part = max(getattr(self.floor, "geoms", [self.floor]), key=lambda polygon: polygon.area)
        return np.asarray(part.exterior.coords)[:-1]


class ModelBank:
    """3D-FUTURE's models: all categories, and meshes on demand in a cache."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self._categories = model_categories(self.folder)
        self._meshes: LRUCache = LRUCache(
            _CACHE_BYTES, lambda mesh: mesh.vertices_m.nbytes + mesh.faces.nbytes
        )

    def category(self, model_id: str) -> str:
        """Category of a model: lower case, "a / b" as "a/b"; "others" if the release has none."""
        return self._categories.get(model_id, "others")

    def lists(self, model_id: str) -> bool:
        """True if the release lists this model; its mesh may nevertheless be missing."""
        return model_id in self._categories

    def has(self, model_id: str) -> bool:
        """True if the release has a mesh of this model."""
        return is_name(model_id) and (self.folder / model_id / MODEL_FILE).is_file()

    def load(self, model_id: str) -> Mesh:
        """Load a mesh in metres. A file is read again if it changed or was evicted from the cache.

        About a hundred models of the release are in centimetres. A model with a side longer than 10
        m is assumed to be in centimetres and scaled by 0.01; `unit_of` finds smaller models in
        centimetres.
        """
        path = self.folder / model_id / MODEL_FILE
        return self._read(path, file_stamp(path))

    @cachedmethod(lambda self: self._meshes)
    def _read(self, path: Path, stamp: tuple[int, int]) -> Mesh:
        mesh = _without_shadow(read_obj(path))
        if float(np.ptp(mesh.vertices_m, axis=0).max()) > _NO_FURNITURE_M:
            return Mesh(mesh.vertices_m / np.float32(100), mesh.faces)
        return mesh


def _without_shadow(mesh: Mesh) -> Mesh:
    """A mesh without flat parts too large for furniture, if its other parts are not: some models
    lie on a plane of 60 m that shows their shadow. The parts of a model in centimetres are all too
    large, and stay."""
    if float(np.ptp(mesh.vertices_m, axis=0).max(initial=0)) <= _NO_FURNITURE_M:
        return mesh
    from trimesh.graph import connected_component_labels

    # Exporters repeat the corners of panels, which alone would be flat parts.
    same = np.unique(mesh.vertices_m, axis=0, return_inverse=True)[1].reshape(-1)
    faces, corners_m = same[mesh.faces], mesh.vertices_m[mesh.faces]
    edges = np.concatenate([faces[:, :2], faces[:, 1:]])
    part = connected_component_labels(edges, int(same.max()) + 1)[faces[:, 0]]
    low_m, high_m = np.full((2, int(part.max()) + 1, 3), [[[np.inf]], [[-np.inf]]])
    np.minimum.at(low_m, part, corners_m.min(axis=1))
    np.maximum.at(high_m, part, corners_m.max(axis=1))
    sides_m = (high_m - low_m)[part]
    large = sides_m.max(axis=1) > _NO_FURNITURE_M
    shadow = large & (sides_m.min(axis=1) < _FLAT_M)
    if shadow.all() or (large & ~shadow).any():
        return mesh
    used, kept = np.unique(mesh.faces[~shadow], return_inverse=True)
    return Mesh(mesh.vertices_m[used], kept.reshape(-1, 3).astype(mesh.faces.dtype))


def unit_of(mesh: Mesh, entry: dict[str, Any]) -> float:
    """Metres per unit of a loaded mesh: 0.01 if it is 50 to 200 times as long as stated, else 1.

    The length is stated by the house's furniture entry. The order of axes in `size` and `bbox`
    varies between entries, so only the longest sides are compared. This finds models in
    centimetres that `ModelBank.load` misses because they are below 10 units long. The factor goes
    into the placement, not into the mesh, so that a model has the same mesh in all houses.
    """
    longest = float(np.ptp(mesh.vertices_m, axis=0).max()) if len(mesh.vertices_m) else 0.0
    for key in ("size", "bbox"):
        try:
            sides = [float(side) for side in entry.get(key)]  # type: ignore[union-attr]
        except (TypeError, ValueError, OverflowError):
            continue
        plausible = len(sides) == 3 and all(1e-3 < side < 1e3 for side in sides)
        if plausible and _OVERSIZED[0] <= longest / max(sides) <= _OVERSIZED[1]:
            return 0.01
    return 1.0
