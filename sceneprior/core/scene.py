"""A room as 3D objects with its floor, doors and windows; `scene_json` has its file format."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in the room frame: vertices (V, 3) in metres, faces (F, 3) as indices.

    Other shapes, vertices that are not finite, and faces with an index out of range, at which the
    z-buffer would read beyond the array, raise an `InputError`.
    """

    vertices_m: np.ndarray
    faces: np.ndarray

    def __post_init__(self) -> None:
        vertices, faces = self.vertices_m, self.faces
        count = len(vertices)
        if vertices.shape != (count, 3) or faces.shape != (len(faces), 3):
            raise InputError(
                f"A mesh has vertices {vertices.shape} and faces {faces.shape}; expected "
                "(vertices, 3) and (faces, 3)."
            )
        if faces.dtype.kind not in "iu" or vertices.dtype.kind not in "iuf":
            raise InputError(
                f"A mesh has vertices of {vertices.dtype} and faces of {faces.dtype}; expected "
                "metres and whole numbers."
            )
        if not np.isfinite(vertices).all():
            raise InputError("A mesh has vertices that are not finite numbers.")
        if len(faces) and not (faces.min() >= 0 and faces.max() < count):
            wrong = faces.max() if faces.max() >= count else faces.min()
            raise InputError(
                f"A face of a mesh names vertex {wrong}, but its {count} vertices are 0 to "
                f"{count - 1}."
            )

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices_m)} vertices, {len(self.faces)} faces)"


def mesh_of_file(vertices_m: np.ndarray, faces: np.ndarray) -> Mesh:
    """Check a mesh read from a file: a valid `Mesh` with at least one triangle."""
    mesh = Mesh(np.asarray(vertices_m), np.asarray(faces))
    if not len(mesh.faces):
        raise InputError("A mesh has no triangle.")
    return mesh


def join_meshes(meshes: Sequence[Mesh]) -> Mesh:
    """All meshes as one, in their order; no vertices are merged."""
    starts = np.cumsum([0, *(len(mesh.vertices_m) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices_m for mesh in meshes]), np.concatenate(faces))


class Textured(NamedTuple):
    """A part of an object's mesh that has one material."""

    mesh: Mesh
    material: Any = None
    """A `PBRMaterial` of trimesh; None for the colour of the object's class."""
    uv: np.ndarray | None = None
    """(V, 2) texture coordinates of the vertices, with the origin at the lower left."""


class Turned(NamedTuple):
    """An oriented box: a rotation about +y (+z towards +x) and sizes."""

    yaw_rad: float
    size_m: tuple[float, float, float]
    """Full extents in the box's own frame."""
    confidence: float = 1.0
    """Probability that the object's front really points along +z of this frame."""


class Solid(NamedTuple):
    """A convex solid in the room frame, inscribed in its axis-aligned box."""

    kind: Literal["box", "cylinder", "ellipsoid", "dome", "bowl"]
    """A kind of `core/parts.py`: cylinders are upright; domes and bowls are half ellipsoids."""
    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]


@dataclass(frozen=True)
class SceneObject:
    """A piece of furniture: class, axis-aligned box in the room frame, and optionally a mesh."""

    label: str
    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    mesh: Mesh | None = None
    turned: Turned | None = None
    """Oriented box whose axis-aligned bounding box has `size_m`, if known."""
    solids: tuple[Solid | Mesh, ...] = field(default=(), repr=False)
    """Convex bodies whose union is the object, or contains it; none if they are not known."""
    textured: tuple[Textured, ...] = field(default=(), repr=False)
    """The surface of `mesh` in parts with materials, for GLBs; none if it has the class colour."""

    def __post_init__(self) -> None:
        # Convert to plain floats, because users print them.
        object.__setattr__(self, "center_m", _triple(self.center_m))
        object.__setattr__(self, "size_m", _triple(self.size_m))

    @property
    def facing(self) -> dict[str, float]:
        """Entries `yaw_rad` and `yaw_confidence` of files, if the object's orientation is known."""
        if self.turned is None:
            return {}
        entries = {"yaw_rad": round(self.turned.yaw_rad, 7)}
        if self.turned.confidence < 1:
            entries["yaw_confidence"] = round(self.turned.confidence, 3)
        return entries

    def in_box(self, center_m: Sequence[float], size_m: Sequence[float]) -> "SceneObject":
        """Copy of the object in another box; mesh and solids are moved and scaled accordingly."""
        center, size = _triple(center_m), _triple(size_m)
        # A flat object has no extent to be scaled.
        scale = np.where(np.array(self.size_m) > 0, size / np.maximum(self.size_m, 1e-9), 1.0)

        def placed(points_m: np.ndarray) -> np.ndarray:
            return (points_m - np.asarray(self.center_m)) * scale + np.asarray(center)

        def rescaled(body: Solid | Mesh) -> Solid | Mesh:
            if isinstance(body, Mesh):
                return Mesh(placed(body.vertices_m), body.faces)
            return Solid(body.kind, *map(_triple, placed(np.array(body[1:])).tolist()))

        solids = tuple(map(rescaled, self.solids))
        reshaped = self.reshaped(placed)
        return SceneObject(
            self.label, center, size, reshaped.mesh, solids=solids, textured=reshaped.textured
        )

    def reshaped(self, move: Callable[[np.ndarray], np.ndarray]) -> "SceneObject":
        """Copy of the object in which a function moves the vertices (V, 3) of the mesh and of its
        textured parts."""
        mesh = self.mesh and Mesh(move(self.mesh.vertices_m), self.mesh.faces)
        textured = tuple(
            part._replace(mesh=Mesh(move(part.mesh.vertices_m), part.mesh.faces))
            for part in self.textured
        )
        return replace(self, mesh=mesh, textured=textured)

    def moved(self, offset_m: Sequence[float]) -> "SceneObject":
        """Copy of the object, moved by x, y and z."""
        center = _triple((np.asarray(self.center_m) + np.asarray(offset_m)).tolist())
        return replace(self.in_box(center, self.size_m), turned=self.turned)


def quarter_turned(size_m: Sequence[float], quarters: int) -> Turned:
    """Describe the axis-aligned box of extents `size_m` as a box rotated by quarter turns.

    >>> quarter_turned((2.0, 0.5, 1.0), 3)
    Turned(yaw_rad=-1.5707963267948966, size_m=(1.0, 0.5, 2.0), confidence=1.0)
    """
    width, height, depth = _triple(size_m)
    own = (width, height, depth) if quarters % 2 == 0 else (depth, height, width)
    return Turned((0.0, np.pi / 2, np.pi, -np.pi / 2)[quarters % 4], own)


def bound_m(turned: Turned) -> tuple[float, float, float]:
    """Extents of the axis-aligned bounding box of an oriented box.

    >>> [round(side, 3) for side in bound_m(Turned(np.pi / 4, (1.0, 0.7, 1.0)))]
    [1.414, 0.7, 1.414]
    """
    width, height, depth = turned.size_m
    cosine, sine = abs(np.cos(turned.yaw_rad)), abs(np.sin(turned.yaw_rad))
    return _triple((cosine * width + sine * depth, height, sine * width + cosine * depth))


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


class Opening(NamedTuple):
    """A door or a window: an upright rectangle in a wall."""

    kind: Literal["door", "window"]
    start_m: tuple[float, float]
    """A lower corner as x, z; `end_m` is the other."""
    end_m: tuple[float, float]
    bottom_m: float
    """Height of its lower edge above the floor: 0 for a door, the sill of a window."""
    top_m: float


@dataclass(frozen=True)
class Scene:
    """Objects of one room, in metres: y up, floor at y = 0, origin at the floor's centre."""

    name: str
    label_set: str
    objects: tuple[SceneObject, ...] = ()
    floor_m: np.ndarray | None = None
    """(P, 2) outline of the floor as x, z; None if unknown. Walls stand on its sides."""
    extra: dict[str, Any] = field(default_factory=dict)
    """Origin of the scene (seed, run, room), written to the JSON and never interpreted."""
    latent: np.ndarray | None = field(default=None, compare=False, repr=False)
    """(D,) latent vector that the scene was decoded from, if any."""
    openings: tuple[Opening, ...] = ()
    """Doors and windows, each on one side of the floor's outline."""
    ceiling_m: float | None = None
    """Height of the ceiling above the floor; None if unknown."""

    def __repr__(self) -> str:
        """The name, the label set and the number of objects per class.

        >>> Scene("empty", "front3d_bedroom")
        Scene('empty', front3d_bedroom: no objects)
        """
        return f"Scene({self.name!r}, {self.label_set}: {self.contents})"

    @property
    def contents(self) -> str:
        """The classes of the objects, most frequent first, with their numbers."""
        counted = Counter(item.label for item in self.objects).most_common()
        words = [label if count == 1 else f"{label} ×{count}" for label, count in counted]
        return ", ".join(words) or "no objects"

    @property
    def class_indices(self) -> np.ndarray:
        """Indices of the objects' classes in the label set, (objects,) int64."""
        names = label_set(self.label_set)
        return np.array([names.index(item.label) for item in self.objects], dtype=np.int64)

    @property
    def centers_m(self) -> np.ndarray:
        """Box centres, (objects, 3) float64."""
        return np.array([item.center_m for item in self.objects], dtype=np.float64).reshape(-1, 3)

    @property
    def sizes_m(self) -> np.ndarray:
        """Full extents of the boxes along x, y, z, (objects, 3) float64."""
        return np.array([item.size_m for item in self.objects], dtype=np.float64).reshape(-1, 3)

    def without_meshes(self) -> "Scene":
        """Copy of the scene in which objects are only boxes, for methods without meshes."""
        bare = (replace(item, mesh=None, solids=(), textured=()) for item in self.objects)
        return replace(self, objects=tuple(bare))
