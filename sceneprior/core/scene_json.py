"""The JSON format of a scene, which generation writes and evaluation reads."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from pydantic import BaseModel, ConfigDict, Field

from sceneprior.core.checked import checked, shown
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError, shortened
from sceneprior.core.files import json_text, read_json
from sceneprior.core.scene import Opening, Scene, SceneObject, Solid, Turned, bound_m

FORMAT = "sceneprior-scene"
VERSION = 1
LARGEST_M = 20.0
"""Maximum length of a piece of furniture; the longest wardrobes and shelves are half as long."""
FARTHEST_M = 100.0
"""Maximum absolute coordinate of a box centre or a corner of the floor."""
MOST_OBJECTS = 1000
"""Maximum number of objects in a room, because metrics compare all pairs."""
MOST_SOLIDS = 200
"""Maximum number of solids of an object."""
BEYOND_BOX_M = 0.05
"""Distance that a solid may reach beyond the box of its object."""
WALL_M = 0.05
"""Maximum distance of a door or a window from the outline of its floor."""
_DECIMALS = 5
_LEAST_M = 10.0**-_DECIMALS


def scene_to_json(scene: Scene) -> dict[str, Any]:
    """Convert a scene to its JSON format (docs/conventions.md): classes and boxes, no meshes."""
    objects = []
    for item in scene.objects:
        entry: dict[str, Any] = {"class": item.label}
        entry["center_m"] = _rounded(item.center_m)
        entry["size_m"] = _rounded_size(item.size_m)
        if item.turned is not None:
            facing = item.facing
            entry["yaw_rad"] = facing.pop("yaw_rad")
            entry |= {"own_size_m": _rounded_size(item.turned.size_m), **facing}
        solids = [solid for solid in item.solids if isinstance(solid, Solid)]
        if solids and len(solids) == len(item.solids):  # the file holds no meshes
            entry["solids"] = [
                {"kind": kind, "low_m": _rounded(low), "high_m": _rounded(high)}
                for kind, low, high in solids
            ]
        objects.append(entry)
    return {
        "format": FORMAT,
        "version": VERSION,
        "name": scene.name,
        "label_set": scene.label_set,
        "units": "metres",
        "axes": "x right, y up, z towards the viewer; floor at y = 0, its centre at the origin",
        "objects": objects,
        **({} if scene.floor_m is None else {"floor_m": scene.floor_m.tolist()}),
        **({"openings": [o._asdict() for o in scene.openings]} if scene.openings else {}),
        **({} if scene.ceiling_m is None else {"ceiling_m": scene.ceiling_m}),
        **({"extra": scene.extra} if scene.extra else {}),
    }


def _rounded(values_m: Sequence[float]) -> list[float]:
    return [round(value, _DECIMALS) for value in values_m]


def _rounded_size(size_m: Sequence[float]) -> list[float]:
    # A flat side stays above 0, because `read_scene` rejects sizes of 0.
    return [max(round(value, _DECIMALS), _LEAST_M) for value in size_m]


# Strict, because "1.8" and true are not valid lengths; JSON has lists for our tuples.
_STRICT = ConfigDict(strict=True)
_Triple = Annotated[tuple[float, float, float], Field(strict=False)]
_Pair = Annotated[tuple[float, float], Field(strict=False)]


class _SolidEntry(BaseModel):
    model_config = _STRICT

    kind: Literal["box", "cylinder", "ellipsoid", "dome", "bowl"]
    low_m: _Triple
    high_m: _Triple


class ObjectEntry(BaseModel):
    """An object of a file."""

    model_config = _STRICT

    label: str = Field(alias="class")
    center_m: _Triple
    size_m: _Triple
    yaw_rad: float | None = None
    own_size_m: _Triple | None = None
    yaw_confidence: Annotated[float, Field(ge=0, le=1)] = 1.0
    solids: Annotated[list[_SolidEntry], Field(max_length=MOST_SOLIDS)] = []


class _OpeningEntry(BaseModel):
    model_config = _STRICT

    kind: Literal["door", "window"]
    start_m: _Pair
    end_m: _Pair
    bottom_m: float
    top_m: float


class _SceneEntry(BaseModel):
    model_config = _STRICT

    name: str | None = None
    label_set: str
    objects: Annotated[list[ObjectEntry], Field(max_length=MOST_OBJECTS)]
    floor_m: Annotated[list[_Pair], Field(min_length=3)] | None = None
    openings: list[_OpeningEntry] = []
    ceiling_m: Annotated[float, Field(gt=0, le=FARTHEST_M)] | None = None
    extra: dict[str, Any] = {}


def read_scene(path: Path) -> Scene:
    """Read a scene's JSON."""
    path = Path(path)
    data = read_json(path)
    where = f"{path} is not a scene JSON, which docs/conventions.md describes"
    if not isinstance(data, dict) or not {"format", "version"} <= data.keys():
        raise InputError(f"{where}: expected an object with 'format', 'version' and 'objects'.")
    if (data["format"], data["version"]) != (FORMAT, VERSION):
        raise InputError(
            f"{path} says format {shown(data['format'])} version {shown(data['version'])}; "
            f"expected '{FORMAT}' version {VERSION}. Write it again with `sceneprior synthesize`."
        )
    entry = checked(_SceneEntry, data, where)
    try:
        json_text(entry.extra)  # it is written again with the scene
    except (ValueError, RecursionError) as error:
        raise InputError(f"{where}: extra cannot be written as JSON ({error}).") from None
    names = label_set(entry.label_set)
    for item in entry.objects:
        if item.label not in names:
            raise InputError(
                f"{path}: class '{shortened(item.label, 60)}' is not in label set "
                f"'{shortened(entry.label_set, 60)}'; use one of {', '.join(names)}."
            )
    objects = [read_object(path, item) for item in entry.objects]
    floor = None if entry.floor_m is None else np.array(entry.floor_m, dtype=np.float64)
    if floor is not None:
        check_floor(path, floor)
    openings = tuple(Opening(**opening.model_dump()) for opening in entry.openings)
    check_openings(path, floor, openings)
    return Scene(
        path.stem if entry.name is None else entry.name,
        entry.label_set,
        tuple(objects),
        floor,
        entry.extra,
        openings=openings,
        ceiling_m=entry.ceiling_m,
    )


def read_object(path: Path | str, item: ObjectEntry) -> SceneObject:
    """An object of a file; its boxes are checked, its class is not."""
    check_box(path, item.label, item.center_m, item.size_m)
    turned = None
    if item.yaw_rad is not None and item.own_size_m is not None:
        check_box(path, item.label, item.center_m, item.own_size_m)
        turned = Turned(item.yaw_rad, item.own_size_m, item.yaw_confidence)
    one = item.yaw_rad is not None or item.own_size_m is not None
    if one and not (turned and np.allclose(bound_m(turned), item.size_m, rtol=0, atol=1e-3)):
        raise InputError(
            f"{path}: a {item.label} of size_m {item.size_m} has yaw_rad {item.yaw_rad} and "
            f"own_size_m {item.own_size_m}; expected both, such that the box turned by yaw_rad "
            "fills size_m, or neither."
        )
    solids = tuple(Solid(**solid.model_dump()) for solid in item.solids)
    check_solids(path, item.label, item.center_m, item.size_m, solids)
    return SceneObject(item.label, item.center_m, item.size_m, turned=turned, solids=solids)


def check_box(
    path: Path | str, label: str, center_m: Sequence[float], size_m: Sequence[float]
) -> None:
    """Reject an implausible box; all readers of boxes use this check."""
    said = f"{path}: a {label} has centre {[*center_m]} and size {[*size_m]}"
    if not np.isfinite([*center_m, *size_m]).all() or min(size_m) <= 0:
        raise InputError(f"{said}; expected finite metres, and sizes above 0.")
    if max(size_m) > LARGEST_M or np.abs(center_m).max() > FARTHEST_M:
        raise InputError(
            f"{said}; no furniture is above {LARGEST_M:g} m long, or further than "
            f"{FARTHEST_M:g} m from the floor's centre. {unit_guess([*center_m, *size_m])}"
        )


def check_solids(
    path: Path | str,
    label: str,
    center_m: Sequence[float],
    size_m: Sequence[float],
    solids: Sequence[Solid],
) -> None:
    """Reject solids without volume, or outside the box of their object."""
    center, half = np.asarray(center_m), np.asarray(size_m) / 2 + BEYOND_BOX_M
    for kind, low, high in solids:
        said = f"{path}: a {label} has a {kind} from {[*low]} to {[*high]}"
        if not np.less(low, high).all():
            raise InputError(f"{said}; expected low_m below high_m along each axis.")
        if not (np.abs([low, high] - center) <= half).all():
            raise InputError(
                f"{said}, which is not in its box (center_m {[*center_m]}, size_m {[*size_m]}); "
                "give solids in the frame of the room, as center_m."
            )


def check_floor(path: Path | str, outline_m: np.ndarray) -> None:
    """Reject a floor outline that is implausibly large, or has no area."""
    far = np.abs(outline_m).max(initial=0)
    if not far <= FARTHEST_M:
        raise InputError(
            f"{path}: the floor reaches {far:g} m from its centre; expected finite metres, at most "
            f"{FARTHEST_M:g}. {unit_guess(far)}"
        )
    if np.linalg.matrix_rank(outline_m - outline_m[0]) < 2:
        raise InputError(f"{path}: all corners of the floor lie on one line, so it has no area.")


def check_openings(
    path: Path | str, outline_m: np.ndarray | None, openings: Sequence[Opening]
) -> None:
    """Reject doors and windows without extent, or farther than 5 cm from the floor's outline."""
    for opening in openings:
        said = f"{path}: a {opening.kind} from {[*opening.start_m]} to {[*opening.end_m]}"
        if outline_m is None:
            raise InputError(f"{said} needs a wall to be in; give floor_m, too.")
        if not (0 <= opening.bottom_m < opening.top_m <= FARTHEST_M):
            raise InputError(
                f"{said} reaches from {opening.bottom_m:g} to {opening.top_m:g} m above the floor; "
                "expected bottom_m of at least 0 and a larger top_m."
            )
        walls = shapely.LineString([*outline_m, outline_m[0]]).buffer(WALL_M)
        line = shapely.LineString([opening.start_m, opening.end_m])
        if not (line.length > 0 and walls.covers(line)):
            raise InputError(
                f"{said} is not on one side of the floor; expected both corners on the outline "
                f"that floor_m lists, to {100 * WALL_M:g} cm."
            )


def unit_guess(numbers: Any) -> str:
    """Question about the unit, for messages about lengths that are too large for metres."""
    unit = "millimetres" if np.abs(numbers).max() > 1000 else "centimetres"
    return f"Are these {unit}? Give metres."
