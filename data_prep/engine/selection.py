"""Which rooms are asked for (`--only`), and which split each is in."""

import csv
import hashlib
import io
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

from data_prep.engine.source import SPLITS, LeftOut, Survey
from sceneprior.errors import InputError

VAL_CHOICES = ("train", "test", "none")
_TEST_SHARE = 0.1


def house_may_match(only: str | None, house: str) -> bool:
    """Whether a house can hold what `--only` names; the beginning of its name is enough."""
    return only is None or house.startswith(only.partition("/")[0]) or only.startswith(f"{house}_")


def is_asked_for(only: str | None, room_id: str, house: str) -> bool:
    """Whether `--only HOUSE`, `HOUSE/ROOM` or a room id names this room (None names all).

    Example:

        >>> is_asked_for("ab/Bedroom-1", "abcd_Bedroom-1", "abcd")
        True
    """
    if only is None:
        return True
    start, slash, room = only.partition("/")
    if slash:
        return house.startswith(start) and room_id == f"{house}_{room}"
    return house.startswith(start) or room_id == only


def read_splits(path: Path, val: str) -> dict[str, str]:
    """Room id -> split, from a CSV of `room id,split`.

    Args:
        path: The file; rows of other shapes (a header) are passed over.
        val: Where rows `val` go: train, test, or none, which leaves those rooms out.

    Raises:
        InputError: the file cannot be read, or has no such row; `val` is none of the three.
    """
    if val not in VAL_CHOICES:
        raise InputError(f"'{val}' is not where val rooms can go; choose train, test or none.")
    try:
        rows = list(csv.reader(io.StringIO(Path(path).read_text())))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"No split file can be read at {path} ({error}).") from None
    meaning = {"train": "train", "test": "test", "val": val, "validation": val}
    found = {
        row[0].strip(): meaning[row[1].strip().lower()]
        for row in rows
        if len(row) >= 2 and row[1].strip().lower() in meaning
    }
    if not found:
        raise InputError(f"{path} has no rows `room id,split` with split train, val or test.")
    return found


def seeded_split(room_ids: Sequence[str], seed: int) -> dict[str, str]:
    """Nine rooms of ten train; an id keeps its place in the order whatever else is there."""
    order = sorted(room_ids, key=lambda item: hashlib.sha256(f"{seed}:{item}".encode()).digest())
    tests = round(_TEST_SHARE * len(order)) or min(1, len(order) - 1)
    return {room_id: "test" if i < tests else "train" for i, room_id in enumerate(order)}


def check_survey(survey: Survey, where: str, only: str | None, hint: str) -> None:
    """Refuse a survey that leaves nothing to prepare, or an empty split.

    Args:
        survey: What was found.
        where: "FOLDER passes the recipe NAME": the end of "No room of ...".
        only: As given; one room has one split.
        hint: What to check if a split is empty.

    Raises:
        InputError: says which, with the most frequent reason.
    """
    if not survey.rooms:
        about = f" for --only {only}" if only else ""
        raise InputError(f"No room of {where}{about} ({_in_words(survey.left_out)}).")
    for split in SPLITS:
        if only is None and not any(room.split == split for room in survey.rooms):
            raise InputError(
                f"The '{split}' split is empty: none of the {len(survey.rooms)} usable rooms is in "
                f"it. Check {hint}."
            )


def _in_words(left_out: Iterable[LeftOut]) -> str:
    reasons = [item.reason for item in left_out]
    # Reasons that differ only in their numbers are one; the first stands for all.
    shapes = Counter(re.sub(r"[\d.]+", "#", reason) for reason in reasons)
    often = ""
    if shapes:
        shape = shapes.most_common(1)[0][0]
        often = next(reason for reason in reasons if re.sub(r"[\d.]+", "#", reason) == shape)
        often = f"; most often as here: {often.rstrip('.')}"
    return f"{len(reasons)} were left out{often}"
