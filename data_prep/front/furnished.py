"""Room and Furniture: a furnished room in its own frame, the result of reading any 3D source."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import shapely

from sceneprior.core.scene import Mesh


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
