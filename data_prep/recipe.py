"""Recipes: which rooms of a source are kept, under which classes, and how cameras stand in them."""

import csv
import functools
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import yaml

from sceneprior.classes import label_set
from sceneprior.errors import InputError

FOLDER = Path(__file__).parent / "recipes"


@dataclass(frozen=True)
class ViewRules:
    """Where cameras stand, and which views are good enough."""

    per_m2: float = 2.0
    """Views for each square metre of floor."""
    at_least: int = 8
    """Views of the smallest room."""
    per_house_at_most: int = 100
    """Shared among the house's rooms by floor area."""
    image_size: tuple[int, int] = (360, 480)
    """(height, width) in pixels."""
    fov_deg: float = 90.0
    """Horizontal field of view."""
    eye_height_m: tuple[float, float] = (1.4, 1.8)
    pitch_deg: tuple[float, float] = (5.0, 25.0)
    """Downwards."""
    wall_margin_m: float = 0.3
    """Cameras keep this far from walls, where the room allows it."""
    furniture_margin_m: float = 0.15
    """Cameras keep this far from the box of a piece that reaches up to the eye."""
    target_distance_m: float = 1.0
    """The piece a camera turns to is at least this far away, measured along the floor."""
    clear_ahead_m: float = 0.35
    """No such box may begin nearer than this in the viewing direction."""
    min_objects: int = 2
    """A view that sees fewer objects (of those the room has) is drawn again ..."""
    min_object_pixels: int = 300
    """... where an object counts from this many pixels on ..."""
    max_object_share: float = 0.6
    """... and so is one that is mostly one object."""
    tries: int = 8
    """After so many tries the best view drawn stays."""


@dataclass(frozen=True)
class Recipe:
    """One data set's rules for one type of room; each rule is off where it is null."""

    name: str
    label_set: str
    class_column: str
    """Column of front3d_categories.csv that holds the class of a category."""
    room_types: tuple[str, ...]
    """A room is of this recipe if its type contains one of these, whatever the case."""
    min_objects: int | None = 2
    """Objects of the label set; void does not count."""
    max_objects: int | None = None
    max_floor_m: float | None = None
    """Longest side of the floor's bounding box."""
    max_height_m: float | None = 4.0
    required_classes: tuple[str, ...] = ()
    """One of these must be there."""
    scale_range: tuple[float, float] | None = (1e-5, 5.0)
    """A room with a piece scaled beyond this (absolute value, each axis) is left out."""
    views: ViewRules = field(default_factory=ViewRules)

    def of_type(self, room_type: str) -> bool:
        """Whether a room of this type is what the recipe is about."""
        return any(word.lower() in room_type.lower() for word in self.room_types)


def load_recipe(name: str, changes: tuple[str, ...] = ()) -> Recipe:
    """Read `recipes/<name>.yaml`, with changes such as `views.per_m2=3` or `max_floor_m=null`.

    Raises:
        InputError: no such recipe, or a rule that recipes do not have.
    """
    path = FOLDER / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(item.stem for item in FOLDER.glob("*.yaml")))
        raise InputError(f"No recipe is called '{name}'; there are {known}.")
    data = yaml.safe_load(path.read_text())
    for change in changes:
        key, equals, value = change.partition("=")
        section, _, rule = key.strip().rpartition(".")
        if not equals or section not in ("", "views"):
            raise InputError(f"'{change}' is not a rule; write it as max_floor_m=8.")
        target = data.setdefault("views", {}) if section else data
        target[rule] = yaml.safe_load(value)
    views = _build(ViewRules, data.pop("views", {}), path)
    recipe = replace(_build(Recipe, {"name": name, **data}, path), views=views)
    label_set(recipe.label_set)
    return recipe


def _build(kind: type, values: dict[str, Any], path: Path) -> Any:
    known = [item.name for item in fields(kind)]
    for key in values:
        if key not in known:
            raise InputError(f"{path.name} has no rule '{key}'; there are {', '.join(known)}.")
    tidy = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
    try:
        return kind(**tidy)
    except TypeError as error:
        raise InputError(f"{path.name}: {error}.") from None


@functools.cache
def category_classes(column: str) -> dict[str, str]:
    """3D-FUTURE's category strings -> class names, from recipes/front3d_categories.csv."""
    with (FOLDER / "front3d_categories.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    if column not in rows[0]:
        raise InputError(f"front3d_categories.csv has no column '{column}'.")
    return {row["model_info_category"]: row[column] for row in rows}
