"""Recipes: rules that select rooms of 3D-FRONT, assign classes and place cameras."""

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import shapely
from pydantic import BeforeValidator, Field

from data_prep.front.furnished import Room
from sceneprior.core.checked import shown
from sceneprior.core.classes import LABEL_SETS, label_set, label_set_name
from sceneprior.core.errors import InputError
from sceneprior.core.files import is_name, read_text
from sceneprior.core.furniture import category_table, class_of_category, tidy_category
from sceneprior.core.settings import Section, apply_override, check_settings, read_yaml

FOLDER = Path(__file__).parents[1] / "recipes"

Finite = Annotated[float, Field(allow_inf_nan=False)]
# strict=False: YAML gives lists for our tuples.
Range = Annotated[tuple[Finite, Finite], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Listed = Annotated[Names, BeforeValidator(lambda names: () if names is None else names)]
Side = Annotated[int, Field(ge=8, le=8192)]


class ViewRules(Section):
    """Rules that place cameras and reject poor views."""

    per_m2: Finite = Field(2.0, gt=0)
    """Views per square metre of floor."""
    at_least: int = Field(8, gt=0)
    """Minimum number of views of a room."""
    per_house_at_most: int = Field(100, gt=0)
    """Maximum number of views of a house, shared among its rooms by floor area."""
    image_size: Annotated[tuple[Side, Side], Field(strict=False)] = (360, 480)
    """(height, width) in pixels."""
    fov_deg: float = Field(90.0, ge=1, le=170)
    """Horizontal field of view."""
    eye_height_m: Range = (1.4, 1.8)
    pitch_deg: Range = (5.0, 25.0)
    """Range of pitch angles, positive downwards."""
    wall_margin_m: Finite = 0.3
    """Distance that cameras keep from walls, if the room allows it."""
    furniture_margin_m: Finite = 0.15
    """Distance that cameras keep from the bounding boxes of furniture."""
    target_distance_m: Finite = 1.0
    """Minimum horizontal distance between a camera and the object it is aimed at."""
    clear_ahead_m: Finite = 0.35
    """Distance in the viewing direction within which no furniture's bounding box may lie."""
    min_objects: int = 2
    """A view with fewer visible objects is redrawn, unless the room has fewer."""
    min_object_pixels: int = 300
    """Smallest number of pixels of an object that counts as visible for `min_objects`."""
    max_object_share: Finite = 0.6
    """A view is redrawn if one object covers more than this share of it."""
    tries: int = Field(8, gt=0)
    """Largest number of tries per view; after that, the best view drawn is kept."""


def _named(given: Any) -> Any:
    """Turn a list of classes into the name of a label set; leave anything else unchanged."""
    if isinstance(given, list) and all(isinstance(name, str) for name in given):
        return label_set_name([name for name in given if name != "void"])
    return given


def _tidied(given: Any) -> Any:
    if not isinstance(given, dict):
        return given
    return {tidy_category(str(category)): label for category, label in given.items()}


class Recipe(Section):
    """Rules for one type of room; a rule that is null is off."""

    name: str
    """Name of the recipe's file without the suffix; also in the shards' names."""
    label_set: Annotated[str, BeforeValidator(_named)]
    """A name in `sceneprior/core/classes.py`, or the user's own list: `[bed, chair]`."""
    categories: Annotated[dict[str, str], BeforeValidator(_tidied)] = Field(default_factory=dict)
    """Class per category of the data set; overrides `class_of_category`."""
    room_types: Names | None
    """Substrings of the accepted room types, in any case; null accepts all types."""
    min_objects: int | None = 2
    """Minimum number of objects of the label set; void does not count."""
    max_objects: int | None = None
    max_floor_m: Finite | None = None
    """Maximum length of the floor's bounding box."""
    max_height_m: Finite | None = 4.0
    required_classes: Listed = ()
    """Classes of which at least one must be present; an empty list or null is off."""
    allowed_categories: Listed = ()
    """Rooms with pieces of other categories are left out; an empty list or null is off."""
    furniture_between_m: Range | None = None
    """Heights above the floor; rooms with furniture beyond this range are left out."""
    min_inside_floor: Share | None = None
    """Minimum share of the furniture whose centre lies above the floor."""
    min_models_share: Share | None = None
    """Minimum share of the furniture that has a model."""
    invalid_rooms: Listed = ()
    """Ids of rooms to leave out, with or without their house; or a file with one id per line."""
    invalid_models: Listed = ()
    """Rooms with one of these models are left out; a list, or a file with one id per line."""
    scale_range: Range | None = (1e-5, 5.0)
    """Rooms with furniture scaled beyond this (absolute value, any axis) are left out."""
    allow_mirrored: bool = True
    """False leaves out rooms with furniture of negative scale."""
    views: ViewRules = Field(default_factory=ViewRules)

    def of_type(self, room_type: str) -> bool:
        """Test whether the recipe accepts this type of room."""
        if self.room_types is None:
            return True
        return any(word.lower() in room_type.lower() for word in self.room_types)

    def class_of(self, category: str) -> str:
        """Class of a category; `void` if it has none."""
        return self.categories.get(category) or class_of_category(category, self.label_set)

    def knows(self, category: str) -> bool:
        """Test whether the class of this category (void included) is stated anywhere.

        It may be stated by `categories`, by a class of the same name or, for a label set of the
        package, by the paper's table.
        """
        if category in self.categories or self.class_of(category) != "void":
            return True
        return self.label_set in LABEL_SETS and category in category_table()


def find_recipe(text: str) -> Path:
    """Find the file of a recipe: a path that ends in .yaml, or the name of a bundled recipe."""
    if Path(text).suffix in (".yaml", ".yml"):
        if not Path(text).is_file():
            raise InputError(f"No recipe at {text}; `sceneprior recipe bedroom` prints one.")
        return Path(text)
    path = FOLDER / f"{text}.yaml"
    if not is_name(text) or not path.is_file():
        known = ", ".join(sorted(item.stem for item in FOLDER.glob("*.yaml")))
        raise InputError(f"No recipe is called '{text}'; choose from {known}, or name a YAML file.")
    return path


def load_recipe(text: str, changes: tuple[str, ...] = ()) -> Recipe:
    """Read a recipe with changes such as `views.per_m2=3` or `max_floor_m=null`."""
    path = find_recipe(text)
    data = {"name": path.stem, **read_yaml(path)}
    for change in changes:
        apply_override(data, change, "--rule")
    for key in ("invalid_rooms", "invalid_models"):
        if isinstance(file := data.get(key), str):
            lines = read_text(Path(file), hint=f"{key} names a file of ids").splitlines()
            data[key] = sorted({line.strip() for line in lines} - {""})
    recipe = check_settings(Recipe, data, path.name)
    if not is_name(recipe.name):
        raise InputError(
            f"{path.name}: shards cannot be named by its name, {ascii(recipe.name)[:60]}."
        )
    names = label_set(recipe.label_set)
    for used in (*recipe.required_classes, *recipe.categories.values()):
        if used not in names:
            raise InputError(
                f"{path.name}: '{used}' is not in its label set, which has {', '.join(names)}."
            )
    return recipe


def recipe_text(name: str) -> str:
    """Text of a bundled recipe with all its categories written out, as a template."""
    if Path(name).suffix in (".yaml", ".yml"):
        raise InputError(
            f"{name} is a file, not a recipe of the package, which `sceneprior recipe` prints; use "
            f"yours as it is: prep-front --recipe {name}."
        )
    text, recipe = read_text(find_recipe(name)), load_recipe(name)
    classes = {category: recipe.class_of(category) for category in category_table()}
    table = [f"  {category}: {label}\n" for category, label in classes.items() if label != "void"]
    head = (
        "# 3D-FUTURE's categories, or others. A category that is not listed gets the class of the\n"
        "# same name, or void. `label_set` may be a list of your own: [bed, night stand].\n"
    )
    return f"{text.rstrip()}\n{head}categories:\n{''.join(table)}"


def broken_rule(room: Room, recipe: Recipe) -> tuple[str, str] | None:
    """First rule that the room breaks: its name and a sentence; None if it breaks none.

    A room that was read without meshes breaks no rule on positions.
    """
    return next(_broken(room, recipe), None)


def _broken(room: Room, recipe: Recipe) -> Iterator[tuple[str, str]]:
    labels = [piece.label for piece in room.furniture if piece.label != "void"]
    models, pieces = len(room.furniture), len(room.furniture) + len(room.without_model)
    if not room.furniture:
        why = f" ({room.notes[0]})" if room.notes else ""
        yield "no_furniture", f"no usable furniture stands in it{why}"
    parts = room.room_id.split("_")  # names of houses and rooms may contain "_", too
    if {"_".join(parts[k:]) for k in range(len(parts))} & set(recipe.invalid_rooms):
        yield "invalid_rooms", "it is among the invalid_rooms"

    def limited(
        name: str, broken: Callable[[Any], bool], said: str, more: str = ""
    ) -> Iterator[tuple[str, str]]:
        limit = getattr(recipe, name)
        if limit is not None and broken(limit):
            yield name, f"{said}, {name} is {limit:g}{more}"

    said = f"there are models of {models} of its {pieces} pieces"
    yield from limited("min_models_share", lambda least: models < least * pieces, said)
    unknown = ", ".join(unknown_categories(room, recipe))
    why = f" (of no class: {unknown})" if unknown else ""
    said = f"{len(labels)} objects"
    yield from limited("min_objects", lambda least: len(labels) < least, said, why)
    yield from limited("max_objects", lambda most: len(labels) > most, said)
    # These two rules also apply to pieces without a model.
    known = [(piece.model_id, piece.category) for piece in room.furniture]
    for model_id, category in (*known, *room.without_model):
        if recipe.allowed_categories and category not in recipe.allowed_categories:
            yield "allowed_categories", f"{shown(category)} is not among allowed_categories"
        if model_id in recipe.invalid_models:
            yield "invalid_models", f"{shown(model_id)} is among the invalid_models"
    if recipe.required_classes and not set(labels) & set(recipe.required_classes):
        names = ", ".join(recipe.required_classes)
        yield "required_classes", f"none of {names}, of which required_classes needs one"
    x1, z1, x2, z2 = room.floor.bounds
    said = f"floor {x2 - x1:.2f} x {z2 - z1:.2f} m"
    yield from limited("max_floor_m", lambda most: max(x2 - x1, z2 - z1) > most, said)
    said = f"height {room.height_m:.2f} m"
    yield from limited("max_height_m", lambda most: room.height_m > most, said)
    if not len(boxes := boxes_m(room)):
        return
    if (limits := recipe.furniture_between_m) is not None:
        low, high = float(boxes[:, 0, 1].min()), float(boxes[:, 1, 1].max())
        if low < limits[0] or high > limits[1]:
            said = f"its furniture reaches from {low:.3f} to {high:.2f} m above the floor"
            between = f"furniture_between_m is {limits[0]:g} to {limits[1]:g}"
            yield "furniture_between_m", f"{said}, {between}"
    outside = outside_floor(room)
    said = f"{outside} of its {len(boxes)} pieces stand outside of the floor"
    yield from limited("min_inside_floor", lambda least: 1 - outside / len(boxes) < least, said)


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
