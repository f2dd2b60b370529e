"""Assigns the scans of a folder to splits by the official lists."""

import re
from collections.abc import Sequence
from pathlib import Path

from sceneprior.core.errors import InputError


def find_scans(folder: Path) -> list[Path]:
    """Find the scan folders in ScanNet's `scans`, sorted.

    A scan folder is named like `scene0000_00` or holds a `.sens` with the folder's name. A folder
    is listed even if its `.sens` is missing, so that the report mentions it.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"No folder at {folder}; --scans names ScanNet's folder of scans.")
    found = [path for path in sorted(folder.iterdir()) if path.is_dir() and _is_scan(path)]
    if not found:
        inside = folder / "scans"
        hint = (
            f"; did you mean {inside}?"
            if inside.is_dir()
            else f"; did you mean {folder.absolute().parent}?"
            if _is_scan(folder.absolute())
            else "."
        )
        raise InputError(f"{folder} holds no scans (scene0000_00/ and so on){hint}")
    return found


def _is_scan(path: Path) -> bool:
    named = re.fullmatch(r"scene\d{4}_\d{2}", path.name)
    return bool(named) or (path / f"{path.name}.sens").is_file()


def space_of(scan_id: str) -> str:
    """Space in which a scan was made: `scene0000` for `scene0000_01`.

    Random splits should be drawn over spaces, or the same room may be in both splits.
    """
    return re.sub(r"_\d{2}$", "", scan_id)


def split_scans(
    folders: Sequence[Path], train: Path | None = None, val: Path | None = None
) -> tuple[dict[str, str], list[str]]:
    """Split scans by the official lists, one scan id per line; `val` becomes the split `test`.

    Returns the split of each listed scan, in the order of the folders, and the listed scans that
    are not on disk.
    """
    listed: dict[str, str] = {}
    for path, split in ((train, "train"), (val, "test")):
        for scan_id in [] if path is None else _read_list(path):
            if listed.setdefault(scan_id, split) != split:
                raise InputError(f"{scan_id} is in both {train} and {val}; a scan has one split.")
    names = [path.name for path in folders]
    split_of = {name: listed[name] for name in names if name in listed}
    if not split_of:
        lists = " and ".join(str(path) for path in (train, val) if path is not None)
        raise InputError(
            f"None of the {len(names)} scans is in {lists or 'a list, as no list is given'}; "
            "check that --train-list and --val-list are ScanNet's scannetv2_train.txt and "
            "scannetv2_val.txt."
        )
    return split_of, [name for name in listed if name not in split_of]


def _read_list(path: Path) -> list[str]:
    try:
        lines = [line.strip() for line in Path(path).read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"The list of scans {path} cannot be read ({error}).") from None
    for number, line in enumerate(lines, 1):
        if re.search(r"[\s,;]", line):
            raise InputError(
                f"{path}, line {number}: '{line[:60]}' is not a scan id; expected one "
                "(scene0000_00) a line, as in scannetv2_train.txt."
            )
    return [line for line in lines if line]
