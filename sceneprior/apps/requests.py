"""Read requests from JSON, and requested floors from files of other programs."""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from sceneprior.core.checked import checked
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.scene_json import MOST_OBJECTS, ObjectEntry, read_object
from sceneprior.interchange.floors import read_floor_file

FORMAT = "sceneprior-request"
VERSION = 1
_STRICT = ConfigDict(strict=True, extra="forbid")
_Pair = Annotated[tuple[float, float], Field(strict=False)]


class RelationEntry(BaseModel):
    """Entry of a relation in a request's JSON."""

    model_config = _STRICT

    subject: str
    relation: str
    target: str | None = None
    count: Annotated[int, Field(ge=1)] = 1


class OpeningEntry(BaseModel):
    """Entry of a door or a window, with both ends, in a request's JSON."""

    model_config = _STRICT

    kind: Literal["door", "window"]
    start_m: _Pair
    end_m: _Pair
    bottom_m: float | None = None
    top_m: float | None = None


class RequestFile(BaseModel):
    """The JSON of a request; `RequestFile.model_json_schema()` is its JSON Schema."""

    model_config = _STRICT

    format: Literal["sceneprior-request"]
    version: Literal[1]
    floor: Annotated[list[_Pair], Field(min_length=3)] | str | None = None
    openings: list[OpeningEntry | str] = []
    ceiling_m: float | None = None
    want: dict[str, list[RelationEntry] | int | str] | str | None = None
    objects: Annotated[list[ObjectEntry], Field(max_length=MOST_OBJECTS)] = []


def load_request(path: str | Path) -> dict[str, Any]:
    """Read a request from JSON, as arguments for `prior.sample(4, **load_request(path))`.

    Raises:
        InputError: the file is no request.
    """
    path = Path(path)
    data = read_json(path)
    where = f"{path} is not a request, which docs/requests.md describes"
    entry = checked(RequestFile, data, where)
    asked: dict[str, Any] = {"floor": entry.floor, "ceiling_m": entry.ceiling_m}
    asked["openings"] = [
        each if isinstance(each, str) else each.model_dump(exclude_none=True)
        for each in entry.openings
    ]
    asked["want"] = entry.want
    if isinstance(entry.want, dict):
        asked["want"] = {
            key: [each.model_dump() for each in value] if isinstance(value, list) else value
            for key, value in entry.want.items()
        }
    asked["objects"] = [read_object(path, item) for item in entry.objects]
    return {key: value for key, value in asked.items() if value not in (None, [])}


def with_floor_of_file(asked: dict[str, Any]) -> dict[str, Any]:
    """Replace a file name given as the floor of a request by the floor in that file. Doors, windows
    and ceiling are also taken from the file, unless the request has its own.

    Raises:
        InputError: the file has no floor.
    """
    floor = asked.get("floor")
    if not isinstance(floor, str | Path) or not (isinstance(floor, Path) or _is_file(floor)):
        return asked
    found = read_floor_file(str(floor))
    own: dict[str, Any] = {"floor": found.outline_m}
    if asked.get("openings") is None:
        own["openings"] = found.openings
    if asked.get("ceiling_m") is None:
        own["ceiling_m"] = found.ceiling_m
    return {**asked, **own}


def _is_file(floor: str) -> bool:
    return floor.partition(":")[0].endswith((".json", ".npz"))


def merged(asked: dict[str, Any], file: dict[str, Any]) -> dict[str, Any]:
    """Merge the arguments of a request with those of a request's file.

    Raises:
        InputError: an argument is in both.
    """
    own = {key: value for key, value in asked.items() if value is not None}
    if both := sorted(own.keys() & file.keys()):
        raise InputError(
            f"Both the request's file and the options have {', '.join(both)}; leave one out."
        )
    return {**file, **own}
