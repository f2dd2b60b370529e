"""Recipes: which rooms of 3D-FRONT are kept, under which classes, and how cameras stand in them."""

from pathlib import Path
from typing import Annotated, Any

from pydantic import BeforeValidator, Field

from data_prep.engine.source import Expected
from sceneprior.classes import LABEL_SETS, label_set, label_set_name
from sceneprior.errors import InputError
from sceneprior.files import is_name
from sceneprior.furniture import category_table, class_of_category, tidy_category
from sceneprior.settings import Section, apply_override, check_settings, read_yaml

FOLDER = Path(__file__).parents[1] / "recipes"

Finite = Annotated[float, Field(allow_inf_nan=False)]
# YAML has lists where we have tuples.
Range = Annotated[tuple[Finite, Finite], Field(strict=False)]
Names = Annotated[tuple[str, ...], Field(strict=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Listed = Annotated[Names, BeforeValidator(lambda names: () if names is None else names)]
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


def _named(given: Any) -> Any:
    """A list of classes as the name of a label set; anything else as it is."""
    if isinstance(given, list) and all(isinstance(name, str) for name in given):
        return label_set_name([name for name in given if name != "void"])
    return given


def _tidied(given: Any) -> Any:
    if not isinstance(given, dict):
        return given
    return {tidy_category(str(category)): label for category, label in given.items()}


class Recipe(Section):
    """One data set's rules for one type of room; each rule is off where it is null."""

    name: str
    """Of its file, without the ending; shards are called after it."""
    label_set: Annotated[str, BeforeValidator(_named)]
    """A name in `sceneprior/classes.py`, or the user's own list: `[bed, chair]`."""
    categories: Annotated[dict[str, str], BeforeValidator(_tidied)] = Field(default_factory=dict)
    """The data set's category -> class, where `class_of_category` does not say so already."""
    room_types: Names | None
    """A room is of this recipe if its type contains one of these, whatever the case; null: all."""
    min_objects: int | None = 2
    """Objects of the label set; void does not count."""
    max_objects: int | None = None
    max_floor_m: Finite | None = None
    """Longest side of the floor's bounding box."""
    max_height_m: Finite | None = 4.0
    required_classes: Listed = ()
    """One of these must be there; null is as good as none."""
    allowed_categories: Listed = ()
    """A room with a piece of another category is left out; none or null: every piece is allowed."""
    furniture_between_m: Range | None = None
    """Above the floor: a room with a piece that reaches lower or higher is left out."""
    min_inside_floor: Share | None = None
    """Share of the furniture whose middle lies above the floor, at least."""
    min_models_share: Share | None = None
    """Share of the furniture for which there is a model, at least."""
    invalid_rooms: Listed = ()
    """Room ids, with their house or without; in a recipe, also a file with one a line."""
    invalid_models: Listed = ()
    """A room with one of these models is left out; a list, or a file."""
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

    def class_of(self, category: str) -> str:
        """The class of a category; `void` where it has none."""
        return self.categories.get(category) or class_of_category(category, self.label_set)

    def knows(self, category: str) -> bool:
        """Whether this category's class, void or not, is stated: by `categories`, by a class of its
        name, or by the paper's table in a label set of the package."""
        if category in self.categories or self.class_of(category) != "void":
            return True
        return self.label_set in LABEL_SETS and category in category_table()


def find_recipe(text: str) -> Path:
    """The file of a recipe: a path that ends in .yaml, or the name of one that ships.

    Raises:
        InputError: there is no such recipe.
    """
    if Path(text).suffix in (".yaml", ".yml"):
        if not Path(text).is_file():
            raise InputError(f"No recipe at {text}; `sceneprior recipe bedroom` prints one.")
        return Path(text)
    path = FOLDER / f"{text}.yaml"
    if not is_name(text) or not path.is_file():
        known = ", ".join(sorted(item.stem for item in FOLDER.glob("*.yaml")))
        raise InputError(f"No recipe is called '{text}'; there are {known}, and files: mine.yaml.")
    return path


def load_recipe(text: str, changes: tuple[str, ...] = ()) -> Recipe:
    """Read a recipe (`find_recipe`), with changes such as `views.per_m2=3` or `max_floor_m=null`.

    Raises:
        InputError: no such recipe, a rule that recipes do not have, or a class outside of its
            label set.
    """
    path = find_recipe(text)
    data = {"name": path.stem, **read_yaml(path)}
    for change in changes:
        apply_override(data, change, "--rule")
    for key in ("invalid_rooms", "invalid_models"):
        if isinstance(data.get(key), str):
            data[key] = _lines(Path(data[key]), key)
    recipe = check_settings(Recipe, data, path.name)
    if not is_name(recipe.name):
        raise InputError(f"{path.name}: its name, {ascii(recipe.name)[:60]}, can name no shards.")
    names = label_set(recipe.label_set)
    for used in (*recipe.required_classes, *recipe.categories.values()):
        if used not in names:
            raise InputError(
                f"{path.name}: '{used}' is no class of its label set, which has {', '.join(names)}."
            )
    return recipe


def _lines(path: Path, key: str) -> list[str]:
    try:
        return sorted({line.strip() for line in path.read_text().splitlines()} - {""})
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{key} names no file of ids that can be read ({error}).") from None


def recipe_text(name: str) -> str:
    """A recipe that ships as a text to start from: with the classes of 3D-FUTURE's categories
    written out.

    Raises:
        InputError: none of this name ships.
    """
    if Path(name).suffix in (".yaml", ".yml"):
        raise InputError(
            f"{name} is a file, not a recipe of the package, which `sceneprior recipe` prints; use "
            f"yours as it is: prep-front --recipe {name}."
        )
    text, recipe = find_recipe(name).read_text(encoding="utf-8"), load_recipe(name)
    classes = {category: recipe.class_of(category) for category in category_table()}
    table = [f"  {category}: {label}\n" for category, label in classes.items() if label != "void"]
    head = (
        "# 3D-FUTURE's categories, or others. One that is not listed is of the class of its own\n"
        "# name, or void. `label_set` may be a list of your own: [bed, night stand].\n"
    )
    return f"{text.rstrip()}\n{head}categories:\n{''.join(table)}"
