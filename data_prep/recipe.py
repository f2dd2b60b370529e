"""Recipes: which rooms of a source are kept, under which classes, and how cameras stand in them."""

import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import yaml

from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.furniture import category_classes

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

    def __post_init__(self) -> None:
        positive = ("per_m2", "at_least", "per_house_at_most", "tries")
        for name in positive:
            if getattr(self, name) <= 0:
                raise InputError(f"views.{name} is {getattr(self, name)}; it must be above 0.")
        if min(self.image_size) < 8 or max(self.image_size) > 8192:
            raise InputError(f"views.image_size is {self.image_size}; sides are 8 to 8192 pixels.")
        if not 1 <= self.fov_deg <= 170:
            raise InputError(f"views.fov_deg is {self.fov_deg}; it lies between 1 and 170 degrees.")


@dataclass(frozen=True)
class Expected:
    """The counts of a finished job on the real data set, where somebody knows them."""

    of: str = ""
    """Which data these counts are of, and who counted: "3D-FRONT, ATISS's index"."""
    rooms: int | None = None
    """Prepared rooms."""
    train: int | None = None
    test: int | None = None
    """Prepared rooms of the split."""
    views: int | None = None
    objects: int | None = None


@dataclass(frozen=True)
class Recipe:
    """One data set's rules for one type of room; each rule is off where it is null."""

    name: str
    label_set: str
    class_columns: tuple[str, ...]
    """Columns of front3d_categories.csv: the first of them that is not void counts."""
    room_types: tuple[str, ...] | None
    """A room is of this recipe if its type contains one of these, whatever the case; null: all."""
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
    allow_mirrored: bool = True
    """False leaves out a room with a piece of negative scale."""
    views: ViewRules = field(default_factory=ViewRules)
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
    data = yaml.safe_load(path.read_text())
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
    views = _build(ViewRules, data.pop("views", None) or {}, path)
    counts = data.pop("expected", None)
    expected = None if counts is None else _build(Expected, counts, path)
    recipe = replace(_build(Recipe, {"name": name, **data}, path), views=views, expected=expected)
    _check_classes(recipe)
    return recipe


def _build(kind: type, values: dict[str, Any], path: Path) -> Any:
    hints = get_type_hints(kind)
    known = [item.name for item in fields(kind)]
    for key in values:
        if key not in known:
            raise InputError(f"{path.name} has no rule '{key}'; there are {', '.join(known)}.")
    tidy = {key: tuple(v) if isinstance(v, list) else v for key, v in values.items()}
    for key, value in tidy.items():
        if not _fits(value, hints[key]):
            wanted = str(getattr(hints[key], "__name__", hints[key])).replace("None", "null")
            raise InputError(f"{path.name}: {key} is {values[key]!r}, but takes {wanted}.")
    try:
        return kind(**tidy)
    except TypeError as error:
        raise InputError(f"{path.name}: {error}.") from None


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value out of YAML is of the type that a rule has."""
    parts = get_args(hint)
    if get_origin(hint) is tuple:
        if parts[-1] is Ellipsis:
            parts = parts[:1] * len(value) if isinstance(value, tuple) else ()
        right = isinstance(value, tuple) and len(value) == len(parts)
        return right and all(_fits(item, part) for item, part in zip(value, parts, strict=True))
    if parts:  # a union
        return any(_fits(value, part) for part in parts)
    if isinstance(value, bool) or hint is bool:
        return isinstance(value, bool) and hint is bool
    if hint is float:
        return isinstance(value, int | float) and math.isfinite(value)
    return isinstance(value, hint)


def _check_classes(recipe: Recipe) -> None:
    names = label_set(recipe.label_set)
    for name in {*recipe.required_classes, *recipe.classes.values()}:
        if name not in names:
            raise InputError(
                f"{recipe.name}: the label set {recipe.label_set} has no class '{name}'; "
                f"it has {', '.join(names)}."
            )
