"""Recipes: which rooms of 3D-FRONT are kept, under which classes, and how cameras stand in them."""

from pathlib import Path
from typing import Annotated

import yaml
from pydantic import BeforeValidator, Field

from data_prep.engine.source import Expected
from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.furniture import category_classes
from sceneprior.settings import Section, check_settings

FOLDER = Path(__file__).parents[1] / "recipes"

Finite = Annotated[float, Field(allow_inf_nan=False)]
# YAML has lists where we have tuples.
Range = Annotated[tuple[Finite, Finite], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]
Side = Annotated[int, Field(ge=8, le=8192)]


class ViewRules(Section):
    """Where cameras stand, and which views are good enough."""

    per_m2: Finite = Field(2.0, gt=0)
    """Views for each square metre of floor."""
    at_least: int = Field(8, gt=0)
    """Views of the smallest room."""
    per_house_at_most: int = Field(100, gt=0)
    """Shared among the house's rooms by floor area."""
    image_size: Annotated[tuple[Side, Side], Field(strict=False)] = (360, 480)
    """(height, width) in pixels."""
    fov_deg: float = Field(90.0, ge=1, le=170)
    """Horizontal field of view."""
    eye_height_m: Range = (1.4, 1.8)
    pitch_deg: Range = (5.0, 25.0)
    """Downwards."""
    wall_margin_m: Finite = 0.3
    """Cameras keep this far from walls, where the room allows it."""
    furniture_margin_m: Finite = 0.15
    """Cameras keep this far from the box of a piece that reaches up to the eye."""
    target_distance_m: Finite = 1.0
    """The piece a camera turns to is at least this far away, measured along the floor."""
    clear_ahead_m: Finite = 0.35
    """No such box may begin nearer than this in the viewing direction."""
    min_objects: int = 2
    """A view that sees fewer objects (of those the room has) is drawn again ..."""
    min_object_pixels: int = 300
    """... where an object counts from this many pixels on ..."""
    max_object_share: Finite = 0.6
    """... and so is one that is mostly one object."""
    tries: int = Field(8, gt=0)
    """After so many tries the best view drawn stays."""


class Recipe(Section):
    """One data set's rules for one type of room; each rule is off where it is null."""

    name: str
    label_set: str
    class_columns: Names
    """Columns of front3d_categories.csv: the first of them that is not void counts."""
    room_types: Names | None
    """A room is of this recipe if its type contains one of these, whatever the case; null: all."""
    min_objects: int | None = 2
    """Objects of the label set; void does not count."""
    max_objects: int | None = None
    max_floor_m: Finite | None = None
    """Longest side of the floor's bounding box."""
    max_height_m: Finite | None = 4.0
    required_classes: Annotated[
        Names, BeforeValidator(lambda names: () if names is None else names)
    ] = ()
    """One of these must be there; null is as good as none."""
    scale_range: Range | None = (1e-5, 5.0)
    """A room with a piece scaled beyond this (absolute value, each axis) is left out."""
    allow_mirrored: bool = True
    """False leaves out a room with a piece of negative scale."""
    views: ViewRules = Field(default_factory=ViewRules)
    expected: Expected | None = None
    """What the report compares with; it decides nothing."""

    def of_type(self, room_type: str) -> bool:
        """Whether a room of this type is what the recipe is about."""
        if self.room_types is None:
            return True
        return any(word.lower() in room_type.lower() for word in self.room_types)

    @property
    def classes(self) -> dict[str, str]:
        """3D-FUTURE's category -> class; what is not listed is void."""
        return category_classes(self.class_columns)


def load_recipe(name: str, changes: tuple[str, ...] = ()) -> Recipe:
    """Read `recipes/<name>.yaml`, with changes such as `views.per_m2=3` or `max_floor_m=null`.

    Raises:
        InputError: no such recipe, or a rule that recipes do not have.
    """
    path = FOLDER / f"{name}.yaml"
    if not path.is_file():
        known = ", ".join(sorted(item.stem for item in FOLDER.glob("*.yaml")))
        raise InputError(f"No recipe is called '{name}'; there are {known}.")
    data = {"name": name, **yaml.safe_load(path.read_text())}
    for change in changes:
        key, equals, value = change.partition("=")
        section, _, rule = key.strip().rpartition(".")
        if not equals or section not in ("", "views"):
            raise InputError(f"'{change}' is not a rule; write it as max_floor_m=8.")
        target = data.setdefault("views", {}) if section else data
        try:
            target[rule] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise InputError(f"The value of '{change}' is no YAML; quote it, or mend it.") from None
    recipe = check_settings(Recipe, data, path.name)
    names = label_set(recipe.label_set)
    for used in {*recipe.required_classes, *recipe.classes.values()}:
        if used not in names:
            raise InputError(
                f"{name}: the label set {recipe.label_set} has no class '{used}'; it has "
                f"{', '.join(names)}."
            )
    return recipe
