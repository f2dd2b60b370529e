"""A cache file for the features of the real rooms' pictures.

Drawing the same real rooms takes most of an evaluation's time. A reference file keeps the features
of the rooms' pictures and a key that names everything the features depend on; a file with another
key is refused.
"""

import io
import json
import zipfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.errors import InputError
from sceneprior.core.files import write_whole
from sceneprior.core.ground_truth import split_fingerprint, stream_scenes
from sceneprior.evaluation.features import Drawing, Features

FORMAT = "sceneprior-reference"
VERSION = 1
_SMALL = "small pictures"

Progress = Callable[[str, int], Callable[[int], object]]
"""(name of the set, number of rooms) -> callback that takes the number of rooms just done."""


def draw_reference(
    shards: Path,
    drawing: Drawing,
    rooms: dict[str, int],
    train_rows: Sequence[int],
    progress: Progress,
    path: Path | None = None,
) -> dict[str, Features]:
    """Features of a split's rooms and of some training rooms, from a reference file if it exists.

    Args:
        rooms: Number of rooms in the two splits: `test` or `val`, and `train`.
        path: Reference file. An existing file is read. Otherwise all rooms of both splits are
            drawn, so that the file covers any later choice of training rooms, and the file is
            written.
    """
    drawn: dict[str, Features] = {}
    if path is not None and path.is_file():
        drawn = _read_reference(path, _key(shards, drawing, rooms), rooms)
    else:
        for split in rooms:
            every = path is not None or split != "train"
            rows = range(rooms[split]) if every else train_rows
            scenes = stream_scenes(shards, split, rows)
            drawn[split] = drawing.features(scenes, progress(split, len(rows)))
        if path is not None:
            _write_reference(path, _key(shards, drawing, rooms), drawn)
    if path is not None:
        chosen = np.asarray(train_rows, dtype=np.int64)
        drawn["train"] = {name: array[chosen] for name, array in drawn["train"].items()}
    return drawn


def _key(shards: Path, drawing: Drawing, splits: Iterable[str]) -> dict[str, Any]:
    """The key of a reference file: everything that its features depend on."""
    key = {
        "format": FORMAT,
        "version": VERSION,
        "networks": drawing.networks,
        _SMALL: drawing.small,
        **{f"render: {name}": value for name, value in drawing.protocol.items()},
        **{f"{split} rooms": split_fingerprint(shards, split) for split in splits},
    }
    return dict(json.loads(json.dumps(key)))


def _write_reference(path: Path, key: dict[str, Any], drawn: dict[str, Features]) -> None:
    arrays: dict[str, Any] = {"key": json.dumps(key)}
    for split, features in drawn.items():
        arrays |= {f"{split}/{name}": array for name, array in features.items()}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    try:
        write_whole(path, buffer.getvalue())
    except OSError as error:
        raise InputError(f"The reference {path} cannot be written ({error.strerror}).") from None


def _read_reference(
    path: Path, wanted: dict[str, Any], splits: Iterable[str]
) -> dict[str, Features]:
    try:
        with np.load(path, allow_pickle=False) as file:
            came = json.loads(str(file["key"]))
            _check_key(path, came, wanted)
            return {
                split: {
                    name.removeprefix(f"{split}/"): file[name]
                    for name in file.files
                    if name.startswith(f"{split}/")
                }
                for split in splits
            }
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path} is not a reference file of `eval-fid` ({type(error).__name__}); delete it to "
            "have it made again, or name another file."
        ) from None


def _check_key(path: Path, came: dict[str, Any], wanted: dict[str, Any]) -> None:
    # A file with more networks or pictures than requested is accepted.
    more = {**came.get("networks", {}), **wanted["networks"]}
    wanted = wanted | {"networks": more, _SMALL: came.get(_SMALL) or wanted[_SMALL]}
    for name in wanted:
        if came.get(name) != wanted[name]:
            raise InputError(
                f"{path} does not fit: its '{name}' differs from what this call would use "
                f"({_brief(came.get(name))} instead of {_brief(wanted[name])}). Name another "
                "file, or delete this one to have it made again."
            )


def _brief(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(value) or "nothing"
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
