"""PNGs of instance ids, tables of their classes, and their renumbering for `observe`."""

import json
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from sceneprior.core.checked import plain
from sceneprior.core.classes import STUFF, VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import check_file, read_table, read_text, reading

SHELL = frozenset(
    ["background", "wall", "floor", "ceiling", "door", "window", "blinds", "mirror", "picture"]
)
"""Classes of parts of the room itself. They become background unless the label set contains them,
because they surround the furniture and are assumed not to occlude it."""
LARGEST_ID = 65_535
_OTHER_NAMES = {"flooring": "floor", "rug": "floor", "carpet": "floor", "windowpane": "window"}
_STUFF_NAME = re.compile(
    r"(wall|door|window|ceiling|floor|flooring|rug|carpet|windowpane)"
    r"(?: (?:wood|marble|stone|tile|brick|concrete|panel|blind|stuff|other|merged))*"
)


def read_class_table(path: Path) -> dict[int, str]:
    """Read the class name of each instance id from a JSON or CSV file.

    A JSON is an object `{"1": "bed", "2": "chair"}` or a list as written by segmenters, alone or
    under `segments_info` or `labels`: `[{"id": 1, "label": "bed", "score": 0.9}, ...]`. In a list,
    the id may also be called `value` or `instance_id`, and the class `class`, `class_name` or
    `name`; a row with id 0 is skipped. A CSV has rows `id,class`, with or without a header.
    """
    try:
        if path.suffix.lower() == ".json":
            pairs = _json_rows(path, read_text(path))
        else:
            rows = [row for row in read_table(path) if any(cell.strip() for cell in row)]
            if rows and not rows[0][0].strip().isdigit():
                rows = rows[1:]
            if short := [row for row in rows if len(row) < 2]:
                raise ValueError(f"a row '{plain(short[0][0])}' has no class")
            pairs = [(row[0].strip(), row[1]) for row in rows]
    except (ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} cannot be read ({str(error)[:120]}).") from None
    classes: dict[int, str] = {}
    for key, name in pairs:
        if not (key.isascii() and key.isdigit()) or not 0 < int(key[:9]) <= LARGEST_ID:
            raise InputError(
                f"{path}: '{plain(key)}' is not an instance id; expected a number from 1 to "
                f"{LARGEST_ID} (0 means no object)."
            )
        if int(key) in classes:
            raise InputError(f"{path}: instance id {int(key)} is listed twice.")
        classes[int(key)] = name
    if not classes:
        raise InputError(f"{path} is empty; expected a class for each instance id.")
    return classes


_IDS = ("id", "value", "instance_id")
_NAMES = ("label", "class", "class_name", "name")
_ROWS = ("segments_info", "labels")


def _json_rows(path: Path, content: str) -> Iterable[tuple[str, str]]:
    # Parsed as pairs, to detect repeated keys.
    data = json.loads(content, object_pairs_hook=_Pairs)
    if isinstance(data, _Pairs) and (listed := [rows for key, rows in data if key in _ROWS]):
        data = listed[0]
    if isinstance(data, list) and not isinstance(data, _Pairs):
        rows = []
        for row in data:
            values = dict(row) if isinstance(row, _Pairs) else {}
            ids = [values[key] for key in _IDS if key in values]
            labels = [values[key] for key in _NAMES if key in values]
            rows.append((str(ids[0]), labels[0]) if ids and labels else ("", None))
    elif isinstance(data, _Pairs):
        rows = [(key.strip(), name) for key, name in data]
    else:
        rows = [("", None)]
    if not all(isinstance(name, str) for _, name in rows):
        raise InputError(
            f'{path} is not an object of ids and class names, as {{"1": "bed", "2": "chair"}} is, '
            f'nor a list as [{{"id": 1, "label": "bed"}}] is.'
        )
    return [(key, str(name)) for key, name in rows if isinstance(data, _Pairs) or key != "0"]


class _Pairs(list[tuple[str, Any]]):
    """A JSON object as (key, value) pairs; a separate type, to distinguish it from a JSON list."""


def tidy(name: str) -> str:
    """Normalise a name for comparison: `Night_Stand` and `night stand` are equal.

    >>> tidy(" Night_Stand ")
    'night stand'
    """
    return " ".join(name.lower().replace("_", " ").replace("-", " ").split())


def stuff_of(name: str) -> int:
    """Index into `STUFF` of a class by its name, also as COCO and ADE20K spell it; 0 for others.

    >>> [STUFF[stuff_of(name)] for name in ("Wall", "floor-other-merged", "rug", "floor lamp")]
    ['wall', 'floor', 'floor', 'unknown']
    """
    found = _STUFF_NAME.fullmatch(tidy(name))
    return STUFF.index(_OTHER_NAMES.get(found[1], found[1])) if found else 0


def nearest(name: str, classes: Sequence[str]) -> str:
    """End of a sentence that asks for the most similar class; "" if none is similar.

    >>> nearest("##chair", ["void", "bed", "chair"]), nearest("teapot", ["bed", "chair"])
    (': chair?', '')
    """
    near = get_close_matches(tidy(re.sub(r"\W+", " ", name)), classes, n=1, cutoff=0.7)
    return f": {near[0]}?" if near else ""


class IdTable:
    """Maps values of masks to consecutive ids for `observe`.

    The k-th instance of the table, `objects[k]`, gets the id k + 1. Values that the table does not
    list get the id after the last instance's; they are void, and may occlude objects. Classes
    outside the label set become void, except those of `SHELL` and `STUFF`, which become background.
    `of_id` is the result of `read_class_table`, and `where` is the beginning of error messages.
    """

    def __init__(self, of_id: dict[int, str], label_set_name: str, where: str):
        names = {tidy(name): i for i, name in enumerate(label_set(label_set_name))}
        stuff = {key: stuff_of(name) for key, name in of_id.items() if tidy(name) not in names}
        shell = [key for key in stuff if stuff[key] or tidy(of_id[key]) in SHELL]
        self.objects = objects = sorted(set(of_id) - set(shell))
        indices = [names.get(tidy(of_id[key]), VOID) for key in objects]
        self.classes = np.array([*indices, VOID], dtype=np.int16)
        if not self.classes.any():
            some = sorted(set(of_id.values()))[:10]
            came = ", ".join(plain(name) + nearest(name, [*names]) for name in some)
            raise InputError(
                f"{where}: none of its classes ({came}) is in the label set "
                f"({', '.join(list(names)[1:11])}{', ...' if len(names) > 11 else ''})."
            )
        self.outside = Counter(of_id[key] for key in objects if tidy(of_id[key]) not in names)
        told = ", ".join(
            f"{plain(name)} ({count}{nearest(name, [*names])})"
            for name, count in sorted(self.outside.items())
        )
        self.notes = [f"classes outside the label set are void: {told}"] if told else []
        self.unlisted: set[int] = set()
        # The last entry is for the value -1.
        self._table = np.full(LARGEST_ID + 2, len(objects) + 1, dtype=np.uint32)
        self._table[[0, *shell]] = 0
        self._table[objects] = np.arange(1, len(objects) + 1)
        self._listed = np.array([-1, 0, *of_id])
        self._stuff = np.zeros(LARGEST_ID + 2, dtype=np.uint8)
        self._stuff[list(stuff)] = list(stuff.values())

    def ids(self, values: np.ndarray) -> np.ndarray:
        """Convert values to ids, (H, W) uint32, and collect unlisted values in `unlisted`."""
        self.unlisted |= set(np.setdiff1d(values, self._listed).tolist())
        return self._table[values]

    def stuff(self, values: np.ndarray) -> np.ndarray:
        """Convert values to indices into `STUFF`, uint8; 0 for objects and unknown values."""
        return self._stuff[values]


_PNG_START = b"\x89PNG\r\n\x1a\n"
_HEADER_BYTES = 26
_COLORS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}


def png_kind(data: bytes) -> tuple[int, str] | None:
    """Bits per channel and colours of a PNG, from its first bytes; None if it is not a PNG."""
    if len(data) < _HEADER_BYTES or not data.startswith(_PNG_START):
        return None
    return data[24], _COLORS.get(data[25], "unknown colours")


def mask_size(path: Path, rgb: bool = False) -> tuple[int, int]:
    """Read the size of a mask, (height, width), without its pixels."""
    with _open(path, rgb) as picture:
        return picture.height, picture.width


def read_mask(path: Path) -> np.ndarray:
    """Read a mask of tracked ids, (height, width) uint16: one value per object, 0 for no object."""
    return _pixels(path, rgb=False).astype(np.uint16)


def read_rgb(path: Path) -> np.ndarray:
    """Read a mask with colour-coded ids, as in COCO's panoptic format: (height, width, 3) uint8."""
    return _pixels(path, rgb=True)


def _pixels(path: Path, rgb: bool) -> np.ndarray:
    with reading(path, " is damaged"), _open(path, rgb) as picture:
        return np.asarray(picture)


def _open(path: Path, rgb: bool) -> Image.Image:
    check_file(path)
    with reading(path, " is not a readable PNG"):
        with path.open("rb") as file:
            kind = png_kind(file.read(_HEADER_BYTES))
        if kind is None:
            raise InputError(f"{path} is not a PNG; give ids as PNGs, which are lossless.")
        # The indices of a palette are the ids, as in DAVIS and the output of most segmenters.
        # Pillow rescales grey values of fewer than 8 bits, so those are rejected.
        wanted = "8-bit RGB, whose colours are segment ids"
        known = kind == (8, "RGB")
        if not rgb:
            wanted = "one channel of 8 or 16 bits, or a palette, whose values are instance ids"
            if kind[1] in ("RGB", "RGBA"):
                wanted += " (docs/posed_data.md turns colours into ids)"
            known = kind in ((8, "grey"), (16, "grey")) or kind[1] == "palette"
        if not known:
            raise InputError(f"{path} is {kind[0]}-bit {kind[1]}; expected {wanted}.")
        return Image.open(path, formats=("PNG",))
