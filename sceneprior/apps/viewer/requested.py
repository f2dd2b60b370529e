"""The page's request as one line of text, and its clauses, each of which can be removed."""

import contextlib
import re
from collections.abc import Callable, Mapping
from typing import Any

from sceneprior.core.errors import InputError
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.lifted.requests.wishes import Wishes, read_wishes

_KEYS = {"floor": "floor", "doors": "openings", "ceiling": "ceiling_m"}
"""Parts of a request beside its sentence: `floor: 0,0 5,0 5,3; doors: door@0:1; two beds`."""
_BETWEEN = re.compile(r"\s*(,|\.(?=\s|$)|\band\b|\bwith\b)\s*")
"""Text between the clauses of a sentence."""


def read_line(line: str, given: RoomRequest) -> RoomRequest:
    """The request of a line.

    Args:
        given: A request whose objects, and whose doors and windows with corners, are added.

    Raises:
        InputError: the line cannot be read.
    """
    own, sentence = given_parts(given), []
    for piece in line.split(";"):
        key, text = _keyed(piece)
        if key is None:
            sentence.append(piece)
        elif key == "openings":
            own[key] = [*filter(None, text.strip(", ").split(",")), *own.get(key, ())]
        else:
            own[key] = _height(text) if key == "ceiling_m" else text
    if want := ";".join(sentence).strip(" ;,"):
        own["want"] = want
    return RoomRequest.of(**own)


def given_parts(request: RoomRequest) -> dict[str, Any]:
    """The parts of a request that a line cannot have."""
    listed = () if isinstance(request.openings, str) else request.openings or ()
    corners = [each for each in listed if isinstance(each, Mapping)]
    return {"objects": request.objects} | ({"openings": corners} if corners else {})


def line_of(request: RoomRequest) -> str:
    """The line of a request; without `given_parts`."""
    floor, openings, want = request.floor, request.openings, request.want
    if isinstance(floor, list):
        floor = " ".join(f"{x:g},{z:g}" for x, z in floor)
    if isinstance(openings, list):
        openings = ",".join(each for each in openings if isinstance(each, str))
    if isinstance(want, Mapping):
        want = sentence_of(read_wishes(want) or Wishes())
    keyed = {"floor": floor, "doors": openings, "ceiling": request.ceiling_m}
    named = [f"{key}: {text}" for key, text in keyed.items() if text]
    return "; ".join([*named, want] if want else named)


def sentence_of(wishes: Wishes) -> str:
    """A sentence with these wishes."""
    said = [*map(str, wishes.counts), *(f"the {wish}" for wish in wishes.relations)]
    return ", ".join(said).replace("_", " ")


def clauses_of(line: str, is_understood: Callable[[str], bool]) -> list[str]:
    """The clauses of a line. One that is not understood by itself, such as "two nightstands beside
    it", is joined to the one before it.

    >>> clauses_of("floor: 4x3; a bed with a view, and a desk", lambda text: text != "a view")
    ['floor: 4x3', 'a bed with a view', 'a desk']
    """
    clauses: list[str] = []
    for piece in line.split(";"):
        if _keyed(piece)[0] is not None:
            clauses.append(piece.strip())
            continue
        own: list[str] = []
        found = _BETWEEN.split(piece.strip())
        for between, text in zip(["", *found[1::2]], found[::2], strict=True):
            if text and own and not is_understood(text):
                own[-1] += f"{' ' * between.isalpha()}{between} {text}"
            elif text:
                own.append(text)
        clauses += own
    return clauses


def line_of_clauses(clauses: list[str]) -> str:
    """The line that has these clauses."""
    keyed = [text for text in clauses if _keyed(text)[0] is not None]
    rest = ", ".join(text for text in clauses if text not in keyed)
    return "; ".join([*keyed, rest] if rest else keyed)


def _keyed(piece: str) -> tuple[str | None, str]:
    """The part of `RoomRequest` to which a piece of a line belongs, if it is not the sentence."""
    key, _, text = piece.partition(":")
    return _KEYS.get(key.strip().lower()), text.strip()


def _height(text: str) -> float:
    with contextlib.suppress(ValueError):
        return float(text.removesuffix("m"))
    raise InputError(f"The ceiling is '{text[:40]}'; expected its height in metres, such as 2.6.")
