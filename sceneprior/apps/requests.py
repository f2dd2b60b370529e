"""Read requests from JSON, and requested floors from files of other programs."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.lifted.requests.request import RequestFile, RoomRequest


def load_request(path: str | Path) -> dict[str, Any]:
    """Read a request from JSON, as arguments for `prior.sample(4, **load_request(path))`.

    Raises:
        InputError: the file is no request.
    """
    data = read_json(Path(path))
    if not isinstance(data, dict):
        raise InputError(
            f"{path} is not a request, which docs/requests.md describes: expected a JSON object."
        )
    parts = RequestFile.of(str(path), **with_floor_of_file(data)).parts()
    own = {key: part for key, part in parts.items() if key in data}
    # A floor's file is only checked here, since options may add openings or a ceiling of their own.
    return own | ({"floor": data["floor"]} if isinstance(data.get("floor"), str) else {})


def request_of(asked: Mapping[str, Any]) -> RoomRequest | None:
    """The request of these parts, of which None is left out; None if there is no part.

    Raises:
        InputError: a part is invalid.
    """
    asked = with_floor_of_file({key: part for key, part in asked.items() if part is not None})
    return RoomRequest.of(**asked) if asked else None


def with_floor_of_file(asked: dict[str, Any]) -> dict[str, Any]:
    """Replace a file name given as the floor of a request by the floor in that file. Doors, windows
    and ceiling are also taken from the file, unless the request has its own.

    Raises:
        InputError: the file has no floor.
    """
    floor = asked.get("floor")
    if not isinstance(floor, str | Path) or not (isinstance(floor, Path) or _is_file(floor)):
        return asked
    from sceneprior.interchange.floors import read_floor_file  # imported here: files only

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
