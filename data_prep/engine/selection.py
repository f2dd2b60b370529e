"""Selects rooms (`--only`) and assigns them to splits."""

import csv
import hashlib
import io
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path

from data_prep.engine.source import Line, Survey
from sceneprior.core.errors import InputError


def house_may_match(only: str | None, house: str) -> bool:
    """Test whether `--only` may select rooms of a house; a prefix of its name suffices."""
    return only is None or house.startswith(only.partition("/")[0]) or only.startswith(f"{house}_")


def is_asked_for(only: str | None, room_id: str, house: str) -> bool:
    """True if `--only HOUSE`, `HOUSE/ROOM` or a room id selects this room; None selects all rooms.

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


def read_splits(path: Path) -> dict[str, str]:
    """Read the split of each room id from a CSV of `room id,split`; other rows are skipped."""
    try:
        rows = list(csv.reader(io.StringIO(Path(path).read_text())))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"No split file can be read at {path} ({error}).") from None
    meaning = {"train": "train", "test": "test", "val": "val", "validation": "val"}
    found = {
        row[0].strip(): meaning[row[1].strip().lower()]
        for row in rows
        if len(row) >= 2 and row[1].strip().lower() in meaning
    }
    if not found:
        raise InputError(f"{path} has no rows `room id,split` with split train, val or test.")
    return found


def seeded_split(
    room_ids: Iterable[str], seed: int, test_share: float = 0.1, val_share: float = 0.0
) -> dict[str, str]:
    """Assign room ids to splits in the order of a seeded hash of each id.

    The relative order of two ids does not depend on the others. A split with a nonzero share gets
    at least one room, `test` before `val`, as long as one is left for `train`.
    """
    order = sorted(room_ids, key=lambda item: hashlib.sha256(f"{seed}:{item}".encode()).digest())
    tests = _size(test_share, len(order), len(order))
    vals = _size(val_share, len(order), len(order) - tests)
    names = ["test"] * tests + ["val"] * vals
    return dict(zip(order, names + ["train"] * (len(order) - len(names)), strict=True))


def _size(share: float, rooms: int, left: int) -> int:
    return min(round(share * rooms) or 1, left - 1) if share > 0 else 0


def of_one_size(
    sizes: Mapping[str, tuple[int, int]], houses: Mapping[str, str] | None = None
) -> tuple[list[str], list[Line]]:
    """Keep the rooms whose images have the most frequent (height, width).

    Batches hold images of several rooms, so all rooms of a folder must have one size. Returns the
    ids of the rooms that are kept, and lines of the report for the others; `houses` has the house
    of each room, which by default is the room itself.
    """
    usual = Counter(sizes.values()).most_common(1)[0][0] if sizes else (0, 0)
    kept, left_out = [], []
    for room_id, size in sizes.items():
        if size == usual:
            kept.append(room_id)
            continue
        why = (
            f"its views are {size[1]} x {size[0]} pixels, those of most rooms {usual[1]} x "
            f"{usual[0]}, and all shards of a folder need one size; prepare it separately"
        )
        house = room_id if houses is None else houses[room_id]
        left_out.append(Line(room_id, house, "filtered", "image_size", why))
    return kept, left_out


def select(survey: Survey, only: str | None, where: str, splits: str = "") -> Survey:
    """Reduce a survey to the rooms that `--only` selects; one to prepare must be left.

    `where` ends the error's sentence "No room of ...": "FOLDER passes the recipe NAME". `splits` is
    the origin of the splits, named in the error if `train` is empty; "" for seeded splits, whose
    `train` is never empty. `val` and `test` may be empty.
    """
    rooms = tuple(room for room in survey.rooms if is_asked_for(only, room.room_id, room.house))
    left_out = tuple(
        item for item in survey.left_out if is_asked_for(only, item.room_id, item.house)
    )
    if not rooms:
        about = f" for --only {only}" if only else ""
        raise InputError(f"No room of {where}{about} ({in_words(left_out)}).")
    if splits and only is None and not any(room.split == "train" for room in rooms):
        raise InputError(
            f"The 'train' split is empty: none of the {len(rooms)} usable rooms is in it. "
            f"Check {splits}."
        )
    return Survey(rooms, left_out)


def in_words(left_out: Iterable[Line]) -> str:
    """Number of rooms left out, and the most frequent reason."""
    reasons = [item.reason for item in left_out]
    # Reasons that differ only in numbers count as one; the first is quoted.
    shapes = Counter(re.sub(r"[\d.]+", "#", reason) for reason in reasons)
    often = ""
    if shapes:
        shape = shapes.most_common(1)[0][0]
        often = next(reason for reason in reasons if re.sub(r"[\d.]+", "#", reason) == shape)
        often = f"; the most frequent reason: {often.rstrip('.')}"
    return f"{len(reasons)} were left out{often}"
