"""Features of the real rooms' pictures, drawn once and kept in a file.

Drawing the same test rooms over and over is what evaluation costs. A reference file keeps what was
read from their pictures, with all that it depends on; a file that does not fit is refused.
"""

import io
import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.errors import InputError
from sceneprior.evaluation.features import SceneFeatures, scene_features
from sceneprior.evaluation.ground_truth import split_fingerprint, stream_scenes
from sceneprior.evaluation.topdown import TopDownProtocol
from sceneprior.files import write_whole
from sceneprior.offscreen import Renderer

FORMAT = "sceneprior-reference"
VERSION = 1
SPLITS = ("test", "train")
_ARRAYS = ("effnet_lite0", "inception", "small", "picture_sha256")
_SMALL = "small pictures"

Progress = Callable[[str, int], Callable[[int], object]]
"""(what is drawn, how many rooms) -> what is called with the number of rooms just done."""


@dataclass(frozen=True)
class Drawing:
    """How pictures are made and read, the same for every set of rooms."""

    view: TopDownProtocol
    renderer: Renderer
    render_protocol: dict[str, Any]
    """As it stands in the result file."""
    networks: dict[str, Any]
    """What reads the pictures, by the result's keys."""
    inception: Path | None
    small: bool

    def features(self, scenes: Any, on_progress: Callable[[int], object]) -> SceneFeatures:
        """Draw and read rooms."""
        return scene_features(
            scenes, self.renderer, self.view, self.inception, self.small, on_progress
        )


def draw_reference(
    shards: Path,
    drawing: Drawing,
    rooms: dict[str, int],
    train_rows: Sequence[int],
    progress: Progress,
    path: Path | None = None,
) -> dict[str, SceneFeatures]:
    """Features of the test rooms and of some training rooms, from a file where there is one.

    Args:
        rooms: How many rooms `test` and `train` hold.
        train_rows: The training rooms wanted.
        path: Reference file. One that lies there is read; otherwise every room of both splits is
            drawn, so that any later choice of training rooms is in it, and the file is written.

    Returns:
        `test` and `train`, the latter in the order of `train_rows`.

    Raises:
        InputError: the file is none, or was made from other rooms or in another way.
    """
    if path is not None and Path(path).is_file():
        stored = _read_reference(Path(path), _key(shards, drawing))
        return {"test": stored["test"], "train": stored["train"].of(train_rows)}
    drawn = {}
    for split in SPLITS:
        every = path is not None or split == "test"
        rows = range(rooms[split]) if every else train_rows
        scenes = stream_scenes(shards, split, rows)
        drawn[split] = drawing.features(scenes, progress(split, len(rows)))
    if path is not None:
        _write_reference(Path(path), _key(shards, drawing), drawn)
        drawn["train"] = drawn["train"].of(train_rows)
    return drawn


def _key(shards: Path, drawing: Drawing) -> dict[str, Any]:
    """All that stored features depend on."""
    key = {
        "format": FORMAT,
        "version": VERSION,
        "networks": drawing.networks,
        _SMALL: drawing.small,
        **{f"render: {name}": value for name, value in drawing.render_protocol.items()},
        **{f"{split} rooms": split_fingerprint(shards, split) for split in SPLITS},
    }
    return dict(json.loads(json.dumps(key)))


def _write_reference(path: Path, key: dict[str, Any], drawn: dict[str, SceneFeatures]) -> None:
    arrays = {
        f"{split}/{name}": getattr(features, name)
        for split, features in drawn.items()
        for name in _ARRAYS
        if getattr(features, name) is not None
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, key=json.dumps(key), **arrays)
    try:
        write_whole(path, buffer.getvalue())
    except OSError as error:
        raise InputError(f"The reference {path} cannot be written ({error.strerror}).") from None


def _read_reference(path: Path, wanted: dict[str, Any]) -> dict[str, SceneFeatures]:
    try:
        with np.load(path, allow_pickle=False) as file:
            came = json.loads(str(file["key"]))
            _check_key(path, came, wanted)
            return {split: _features(file, split) for split in SPLITS}
    except InputError:
        raise
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(
            f"{path} is no reference of `eval-fid` ({type(error).__name__}); delete it to have it "
            "made again, or name another file."
        ) from None


def _features(file: Any, split: str) -> SceneFeatures:
    def optional(name: str) -> np.ndarray | None:
        return file[f"{split}/{name}"] if f"{split}/{name}" in file.files else None

    return SceneFeatures(
        effnet_lite0=file[f"{split}/effnet_lite0"],
        inception=optional("inception"),
        small=optional("small"),
        picture_sha256=file[f"{split}/picture_sha256"],
    )


def _check_key(path: Path, came: dict[str, Any], wanted: dict[str, Any]) -> None:
    # A file that knows more than is asked fits, too.
    more = {**came.get("networks", {}), **wanted["networks"]}
    wanted = wanted | {"networks": more, _SMALL: came.get(_SMALL) or wanted[_SMALL]}
    for name in wanted:
        if came.get(name) != wanted[name]:
            raise InputError(
                f"{path} does not fit: its '{name}' is not what this call would draw or read with "
                f"({_brief(came.get(name))} instead of {_brief(wanted[name])}). Name another "
                "file, or delete this one to have it made again."
            )


def _brief(value: Any) -> str:
    if isinstance(value, dict):
        return ", ".join(value) or "nothing"
    text = str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
