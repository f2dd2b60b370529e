"""Room and Furniture: what every 3D source is read into, in the room's own frame."""

from dataclasses import dataclass, field

import numpy as np
import shapely

from sceneprior.scene import Mesh


@dataclass(frozen=True)
class Furniture:
    """One piece of furniture where it stands."""

    label: str
    """Class in the recipe's label set; `void` for what is outside the list."""
    category: str
    """What the data set itself calls it, in lower case."""
    model_id: str
    model: Mesh
    """The model in its own frame (metres, y up, front +z), shared by all its copies."""
    model_to_room: np.ndarray
    """(4, 4) float64: scale (negative where mirrored), turn, place."""

    @property
    def mesh(self) -> Mesh:
        """The piece in the room frame, its faces turned right side out again if mirrored."""
        linear, place = self.model_to_room[:3, :3], self.model_to_room[:3, 3]
        faces = self.model.faces
        if np.linalg.det(linear) < 0:
            faces = faces[:, ::-1]
        return Mesh(self.model.vertices_m @ linear.T + place, faces)

    @property
    def yaw_rad(self) -> float:
        """The turn about +y that takes +z to the piece's front."""
        front = self.model_to_room[:3, 2]
        return float(np.arctan2(front[0], front[2]))


@dataclass(frozen=True)
class Room:
    """A furnished room: y up, floor at y = 0, the centre of the floor's bounding box the origin."""

    room_id: str
    """`<house>_<instanceid>`."""
    type: str
    floor: shapely.Polygon | shapely.MultiPolygon
    """In x and z, metres."""
    height_m: float
    """Floor to ceiling."""
    furniture: tuple[Furniture, ...]
    notes: tuple[str, ...] = field(default=())
    """What was left out of the room, and why."""
    without_model: int = 0
    """Pieces that are left out because there is no model of theirs."""

    @property
    def floor_outline_m(self) -> np.ndarray:
        """(P, 2) x and z along the outline of the floor (of its largest part), without repeat."""
        part = max(getattr(self.floor, "geoms", [self.floor]), key=lambda polygon: polygon.area)
        return np.asarray(part.exterior.coords)[:-1]
