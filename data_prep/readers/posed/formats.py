"""Parses `--from` and `--label-set`; guesses the tools that wrote a room's poses and masks."""

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from data_prep.readers.posed.coco import CocoMasks, PanopticPngs
from data_prep.readers.posed.masks import MaskFormat
from data_prep.readers.posed.segmenters import (
    GroundedSam2,
    GroundedSam2Images,
    IdPngs,
    ObjectFolders,
)
from data_prep.readers.posed.transforms import POSES
from sceneprior.core.checked import plain, shown
from sceneprior.core.classes import LABEL_SETS, label_set, label_set_name
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json, read_table, read_text
from sceneprior.core.id_tables import tidy

_MASKS: tuple[type[MaskFormat], ...] = (
    IdPngs, PanopticPngs, ObjectFolders, GroundedSam2, GroundedSam2Images, CocoMasks,
)  # fmt: skip
MASKS = tuple(dict.fromkeys(masks.name for masks in _MASKS))
"""Names of the formats of masks."""


def mask_files(folder: Path) -> list[Path]:
    """The files of a room's masks in all formats."""
    return sorted({path for masks in _MASKS for path in masks.find(folder)})


def mask_format(folder: Path, given: str | None) -> type[MaskFormat]:
    """Format of a room's masks, guessed unless it is given. If no masks are found, it is `IdPngs`,
    whose error message asks the user for PNGs of ids."""
    found = [masks for masks in _MASKS if masks.find(folder)]
    if given is not None:
        named = [masks for masks in _MASKS if masks.name == given]
        chosen = [masks for masks in named if masks in found]
        if not chosen and given != IdPngs.name:
            raise InputError(
                f"{folder} has no masks of {named[0].title}; leave out --from {given} to guess."
            )
        return (chosen or named)[0]
    if PanopticPngs in found and IdPngs in found:
        found.remove(IdPngs)
    if len(found) > 1:
        raise InputError(
            f"{folder} has masks of {' and of '.join(masks.title for masks in found)}; choose "
            f"with --from {' or --from '.join(masks.name for masks in found)}."
        )
    return (found or [IdPngs])[0]


def read_formats(names: Iterable[str]) -> dict[str, Any]:
    """Parse the values of `--from`: at most one format of `poses` and one of `masks`."""
    given: dict[str, str] = {}
    for name in names:
        kind = "poses" if name in POSES else "masks"
        if name not in POSES and name not in MASKS:
            raise InputError(
                f"--from {shown(name)} is not known; choose from {', '.join(POSES)} for poses, and "
                f"from {', '.join(MASKS)} for masks."
            )
        if given.setdefault(kind, name) != name:
            raise InputError(
                f"--from {given[kind]} and --from {name} are both formats of {kind}; give one of "
                "them, and one of the other kind."
            )
    return given


def read_class_map(path: Path | None, label_set_name: str) -> tuple[tuple[str, str], ...]:
    """Read `--class-map`, a CSV with rows `name of the masks,class`: names as `tidy`, and classes
    of the label set, void included."""
    rows = [] if path is None else read_table(path)
    known = {tidy(name): name for name in label_set(label_set_name)}
    found = {}
    for number, row in enumerate(rows, start=1):
        if any(cell.strip() for cell in row):
            if len(row) != 2 or tidy(row[1]) not in known:
                raise InputError(
                    f"{path}, row {number} is {shown(','.join(row))}; expected a name of the masks "
                    f"and its class, one of {plain(', '.join(known.values()), 400)}."
                )
            found[tidy(row[0])] = known[tidy(row[1])]
    return tuple(found.items())


def read_label_set(text: str) -> str:
    """Resolve `--label-set` to the name of a label set, as for `label_set` in a config.

    The text is such a name, or a file with one class per line or a JSON list. The file need not
    contain `void`; lines that begin with # are skipped.
    """
    path = Path(text)
    if text.startswith("void,"):
        return label_set_name([name.strip() for name in text.split(",")[1:]])
    is_file = False
    with contextlib.suppress(OSError):  # the name is too long
        is_file = path.is_file()
    if not is_file:
        if text in LABEL_SETS:
            return text
        raise InputError(
            f"--label-set {text} is neither a file with one class per line, nor one of "
            f"{', '.join(LABEL_SETS)}, nor a list such as void,bed,chair."
        )
    is_json = path.suffix.lower() == ".json"
    names = read_json(path) if is_json else list(map(str.strip, read_text(path).splitlines()))
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path} holds no list of class names.")
    try:
        return label_set_name(
            [name for name in names if name and name != "void" and not name.startswith("#")]
        )
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
