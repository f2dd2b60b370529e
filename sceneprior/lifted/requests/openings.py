"""Doors and windows of requests, and their places in walls."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
import shapely
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from sceneprior.core.checked import shown
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening
from sceneprior.core.scene_json import check_openings
from sceneprior.core.shell import Wall
from sceneprior.lifted.requests.floors import Floor

USUAL_M = {"door": (0.9, 0.0, 2.0), "window": (1.2, 0.9, 2.1)}
"""Default width, lower edge and upper edge of doors and windows."""
MARGIN_M = 0.1
"""Distance of drawn doors and windows from the ends of their wall and from each other."""
MOST_OPENINGS = 50
PLACES = 50
"""Maximum number of places drawn for a door or a window."""
COMPASS = {"north": (0.0, -1.0), "east": (1.0, 0.0), "south": (0.0, 1.0), "west": (-1.0, 0.0)}
"""Directions (x, z) out of the room by the names of walls. North is up in top-down pictures."""
_TEXT = re.compile(
    rf"\s*(door|window)s?(?:\s*@\s*({'|'.join(COMPASS)}|\d+)(?:\s*:\s*(\d+\.?\d*))?)?\s*"
)


_Pair = Annotated[tuple[float, float], Field(strict=False)]


class _OpeningEntry(BaseModel):
    """A door or window with both ends, as in a scene's JSON."""

    model_config = ConfigDict(strict=True, extra="forbid")

    kind: Literal["door", "window"]
    start_m: _Pair
    end_m: _Pair
    bottom_m: float | None = None
    top_m: float | None = None


@dataclass(frozen=True)
class WantedOpening:
    """A requested door or window; the unspecified part of its position is sampled."""

    kind: Literal["door", "window"]
    wall: str | int | None = None
    """A name of `COMPASS`, the number of a side of the floor, or None for any side."""
    at_m: float | None = None
    """Distance of the middle from the wall's first end, which is the western or northern end for a
    wall of `COMPASS`."""

    def __str__(self) -> str:
        side = "" if self.wall is None else f"@{self.wall}"
        return f"{self.kind}{side}" + ("" if self.at_m is None else f":{self.at_m:g}")


def read_openings(openings: Any) -> tuple[Opening | WantedOpening, ...]:
    """Read doors and windows from a string or a list.

    A string has entries `door`, `door@north`, `door@2` (the side from corner 2 of the floor) or
    `window@south:1.5` (its middle 1.5 m from the wall's western or northern end), separated by
    commas. A list may have such entries, `Opening`s, or mappings with the keys of a scene's JSON.

    Raises:
        InputError: an entry is malformed.
    """
    if not isinstance(openings, Sequence):
        raise InputError(
            f"The openings are {shown(openings)}; expected text such as door,window@north, or a "
            "list."
        )
    entries = openings.split(",") if isinstance(openings, str) else list(openings)
    if len(entries) > MOST_OPENINGS:
        raise InputError(
            f"The request has {len(entries)} openings; expected at most {MOST_OPENINGS}."
        )
    return tuple(_read_opening(entry) for entry in entries)


def _read_opening(entry: Any) -> Opening | WantedOpening:
    if isinstance(entry, Opening):
        return entry
    if isinstance(entry, Mapping):
        try:
            found = _OpeningEntry.model_validate(dict(entry))
        except ValidationError:
            raise InputError(
                f"An opening is {str(dict(entry))[:80]}; expected kind (door or window), start_m "
                "and end_m as [x, z], and bottom_m and top_m where they differ from the usual."
            ) from None
        _, bottom_m, top_m = USUAL_M[found.kind]
        bottom_m = bottom_m if found.bottom_m is None else found.bottom_m
        top_m = top_m if found.top_m is None else found.top_m
        return Opening(found.kind, found.start_m, found.end_m, bottom_m, top_m)
    text = _TEXT.fullmatch(entry) if isinstance(entry, str) else None
    if text is None:
        raise InputError(
            f"An opening is {str(entry)[:40]!r}; expected door, window@north or door@south:1.5 (a "
            f"wall is {', '.join(COMPASS)} or a number; then metres along it)."
        )
    wall = int(text[2]) if text[2] and text[2] not in COMPASS else text[2]
    at_m = None if text[3] is None else float(text[3])
    return WantedOpening("door" if text[1] == "door" else "window", wall, at_m)


def place_openings(
    floor: Floor, wanted: Sequence[Opening | WantedOpening], draws: np.random.Generator
) -> tuple[Opening, ...]:
    """Doors and windows of one room. Unspecified positions are sampled uniformly along the walls.

    Raises:
        InputError: an opening lies on no side of the floor, or there is no free wall for it.
    """
    placed = [each for each in wanted if isinstance(each, Opening)]
    check_openings("The request", floor.outline_m, placed)
    for each in sorted(
        (each for each in wanted if isinstance(each, WantedOpening)),
        key=lambda each: (each.at_m is None, each.wall is None),
    ):
        placed.append(_placed(each, floor.walls, placed, draws))
    return tuple(placed)


def _placed(
    wanted: WantedOpening, walls: list[Wall], there: list[Opening], draws: np.random.Generator
) -> Opening:
    width_m, bottom_m, top_m = USUAL_M[wanted.kind]
    choice = walls_for(wanted, walls)
    room_m = np.array([max(wall.length_m - width_m - 2 * MARGIN_M, 0.0) for wall in choice])
    taken = shapely.MultiLineString([[each.start_m, each.end_m] for each in there])
    where = f"on {wanted.wall} " if wanted.wall is not None else ""
    for _ in range(PLACES if wanted.at_m is None else 1):
        wall, at_m = choice[0], wanted.at_m
        if at_m is None:
            if not room_m.any():
                break
            row = draws.choice(len(choice), p=room_m / room_m.sum())
            wall, at_m = choice[row], width_m / 2 + MARGIN_M + room_m[row] * draws.random()
        elif not width_m / 2 <= at_m <= wall.length_m - width_m / 2:
            raise InputError(
                f"A {wanted.kind} {where}is {at_m:g} m along a wall of {wall.length_m:.2f} m; it "
                f"is {width_m:g} m wide and must lie in the wall."
            )
        ends = [wall.start_m + wall.direction * (at_m + s * width_m / 2) for s in (-1, 1)]
        if taken.is_empty or shapely.LineString(ends).distance(taken) >= MARGIN_M:
            start_m, end_m = ((float(x), float(z)) for x, z in ends)
            return Opening(wanted.kind, start_m, end_m, bottom_m, top_m)
    raise InputError(
        f"A {wanted.kind} {where}finds no free wall of {width_m + 2 * MARGIN_M:g} m; the floor is "
        "too small for its doors and windows, or they are in each other's way."
    )


def walls_for(wanted: WantedOpening, walls: list[Wall]) -> list[Wall]:
    """Walls on which an opening may lie. Walls of `COMPASS` run from west to east or from north to
    south."""
    if wanted.wall is None:
        return walls if wanted.at_m is None else walls[:1]
    if isinstance(wanted.wall, int):
        if wanted.wall >= len(walls):
            raise InputError(
                f"A {wanted.kind} is on side {wanted.wall}, but the floor has sides 0 to "
                f"{len(walls) - 1}."
            )
        return [walls[wanted.wall]]
    outwards = np.array(COMPASS[wanted.wall])
    facing = [wall for wall in walls if wall.outward @ outwards > np.cos(np.pi / 4) - 1e-6]
    if not facing:
        raise InputError(f"The floor has no wall in the {wanted.wall}; name it by its number.")
    longest = max(facing, key=lambda wall: wall.length_m)
    backwards = (longest.end_m - longest.start_m).sum() < 0
    return [Wall(longest.end_m, longest.start_m, longest.outward) if backwards else longest]
