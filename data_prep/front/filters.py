"""The rules of a recipe that leave rooms out."""

from collections import Counter

from data_prep.front.furnished import Room
from data_prep.front.recipe import Recipe


def broken_rule(room: Room, recipe: Recipe) -> tuple[str, str] | None:
    """The name of the first rule that the room breaks, and a sentence; None if it breaks none."""
    labels = [piece.label for piece in room.furniture if piece.label != "void"]
    x1, z1, x2, z2 = room.floor.bounds
    if not room.furniture:
        why = f" ({room.notes[0]})" if room.notes else ""
        return "no_furniture", f"no usable furniture stands in it{why}"
    if recipe.min_objects is not None and len(labels) < recipe.min_objects:
        unknown = ", ".join(unknown_categories(room, recipe))
        why = f" (of no class: {unknown})" if unknown else ""
        return "min_objects", f"{len(labels)} objects, min_objects is {recipe.min_objects}{why}"
    if recipe.max_objects is not None and len(labels) > recipe.max_objects:
        return "max_objects", f"{len(labels)} objects, max_objects is {recipe.max_objects}"
    if recipe.required_classes and not set(labels) & set(recipe.required_classes):
        names = ", ".join(recipe.required_classes)
        return "required_classes", f"none of {names}, which required_classes asks for"
    if recipe.max_floor_m is not None and max(x2 - x1, z2 - z1) > recipe.max_floor_m:
        floor = f"floor {x2 - x1:.2f} x {z2 - z1:.2f} m"
        return "max_floor_m", f"{floor}, max_floor_m is {recipe.max_floor_m:g}"
    if recipe.max_height_m is not None and room.height_m > recipe.max_height_m:
        height = f"height {room.height_m:.2f} m"
        return "max_height_m", f"{height}, max_height_m is {recipe.max_height_m:g}"
    return None


def unknown_categories(room: Room, recipe: Recipe) -> dict[str, int]:
    """Category -> pieces that are void because the recipe says nothing about it, most first."""
    pieces = Counter(piece.category for piece in room.furniture if not recipe.knows(piece.category))
    return dict(pieces.most_common())
