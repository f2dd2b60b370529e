"""A furnished room in its own frame, and the rules of a recipe that it may break."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import shapely

from data_prep.front.recipe import Recipe
from sceneprior.core.checked import shown
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


def broken_rule(room: Room, recipe: Recipe) -> tuple[str, str] | None:
    """First rule that the room breaks: its name and a sentence; None if it breaks none."""
    labels = [piece.label for piece in room.furniture if piece.label != "void"]
    x1, z1, x2, z2 = room.floor.bounds
    if not room.furniture:
        why = f" ({room.notes[0]})" if room.notes else ""
        return "no_furniture", f"no usable furniture stands in it{why}"
    parts = room.room_id.split("_")  # names of houses and rooms may contain "_", too
    ids = {"_".join(parts[k:]) for k in range(len(parts))}
    if not ids.isdisjoint(recipe.invalid_rooms):
        return "invalid_rooms", "it is among the invalid_rooms"
    pieces = len(room.furniture) + len(room.without_model)
    least = recipe.min_models_share
    if least is not None and len(room.furniture) < least * pieces:
        known_ones = f"there are models of {len(room.furniture)} of its {pieces} pieces"
        return "min_models_share", f"{known_ones}, min_models_share is {least:g}"
    if recipe.min_objects is not None and len(labels) < recipe.min_objects:
        unknown = ", ".join(unknown_categories(room, recipe))
        why = f" (of no class: {unknown})" if unknown else ""
        return "min_objects", f"{len(labels)} objects, min_objects is {recipe.min_objects}{why}"
    if recipe.max_objects is not None and len(labels) > recipe.max_objects:
        return "max_objects", f"{len(labels)} objects, max_objects is {recipe.max_objects}"
    # These two rules also apply to pieces without a model.
    known = [(piece.model_id, piece.category) for piece in room.furniture]
    for model_id, category in (*known, *room.without_model):
        if recipe.allowed_categories and category not in recipe.allowed_categories:
            return "allowed_categories", f"{shown(category)} is not among allowed_categories"
        if model_id in recipe.invalid_models:
            return "invalid_models", f"{shown(model_id)} is among the invalid_models"
    if recipe.required_classes and not set(labels) & set(recipe.required_classes):
        names = ", ".join(recipe.required_classes)
        return "required_classes", f"none of {names}, of which required_classes needs one"
    if recipe.max_floor_m is not None and max(x2 - x1, z2 - z1) > recipe.max_floor_m:
        floor = f"floor {x2 - x1:.2f} x {z2 - z1:.2f} m"
        return "max_floor_m", f"{floor}, max_floor_m is {recipe.max_floor_m:g}"
    if recipe.max_height_m is not None and room.height_m > recipe.max_height_m:
        height = f"height {room.height_m:.2f} m"
        return "max_height_m", f"{height}, max_height_m is {recipe.max_height_m:g}"
    return _broken_by_meshes(room, recipe)


def _broken_by_meshes(room: Room, recipe: Recipe) -> tuple[str, str] | None:
    """First broken rule on mesh positions; None for a room that was read without meshes."""
    boxes = boxes_m(room)
    if not len(boxes):
        return None
    if (limits := recipe.furniture_between_m) is not None:
        low, high = float(boxes[:, 0, 1].min()), float(boxes[:, 1, 1].max())
        if low < limits[0] or high > limits[1]:
            text = f"its furniture reaches from {low:.3f} to {high:.2f} m above the floor"
            said = f"furniture_between_m is {limits[0]:g} to {limits[1]:g}"
            return "furniture_between_m", f"{text}, {said}"
    outside = outside_floor(room)
    inside = 1 - outside / len(boxes)
    if recipe.min_inside_floor is not None and inside < recipe.min_inside_floor:
        text = f"{outside} of its {len(boxes)} pieces stand outside of the floor"
        return "min_inside_floor", f"{text}, min_inside_floor is {recipe.min_inside_floor:g}"
    return None


def boxes_m(room: Room) -> np.ndarray:
    """Lower and upper corner of each mesh, (pieces, 2, 3); (0, 2, 3) if no mesh was read."""
    meshes = [piece.mesh.vertices_m for piece in room.furniture if len(piece.model.vertices_m)]
    return np.array([(mesh.min(axis=0), mesh.max(axis=0)) for mesh in meshes]).reshape(-1, 2, 3)


def outside_floor(room: Room) -> int:
    """Number of pieces whose centre is not above the floor."""
    middles = boxes_m(room).mean(axis=1)
    return int((~shapely.covers(room.floor, shapely.points(middles[:, [0, 2]]))).sum())


def unknown_categories(room: Room, recipe: Recipe) -> dict[str, int]:
    """Number of pieces per category that the recipe does not mention, most frequent first."""
    pieces = Counter(piece.category for piece in room.furniture if not recipe.knows(piece.category))
    return dict(pieces.most_common())
