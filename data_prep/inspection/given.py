"""The files from which a folder's cameras were read, and the convention of their matrices."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from data_prep.engine.report import REPORT_NAME
from data_prep.engine.selection import in_words
from data_prep.engine.source import Line
from data_prep.inspection.causes import C2W, OPENCV, OPENGL, W2C, Convention
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json


class Given(NamedTuple):
    """Origin of one room's cameras."""

    file: str
    """Name for messages: transforms.json."""
    convention: Convention = Convention()
    posed: bool = False
    """True for rooms of prep-posed, whose options the messages may name."""


_OF_SOURCE = {
    "posed": Given("the file of poses", Convention(C2W, OPENGL), True),
    "scannet": Given("the scans' .sens files", Convention(C2W, OPENCV)),
    "3d-front": Given("the shards (`world_to_camera`)"),
}
_COLMAP = ("cameras.bin", "cameras.txt")


def given_of(folder: Path, source: Any) -> tuple[Given, dict[str, Given], str | None]:
    """Usual origin of the cameras of a source (from index.json); origin of the cameras of single
    rooms by id; and a sentence if more rooms failed than were prepared.

    The report states the origin of a room's poses (`PreparedRoom.cameras`). If the report is
    missing or from an earlier release, the usual origin of the source is assumed.
    """
    usual = _OF_SOURCE.get(str(source), _OF_SOURCE["3d-front"])
    try:
        lines = [Line(**line) for line in read_json(folder / REPORT_NAME)["rooms"]]
        rooms = {line.room_id: _given(usual, **line.cameras) for line in lines if line.cameras}
    except (InputError, KeyError, TypeError, ValueError):
        return usual, {}, None
    failed = [line for line in lines if line.status == "failed"]
    prepared = sum(line.status == "prepared" for line in lines)
    said = f"{len(lines)} rooms, {prepared} prepared: {in_words(failed)}"
    return usual, rooms, said if len(failed) > prepared else None


def _given(usual: Given, file: str, room_from_world: list[list[float]]) -> Given:
    world = np.array(room_from_world, dtype=np.float64).reshape(4, 4)
    if Path(file).name in _COLMAP:
        place = Path(file).parent.as_posix()
        return usual._replace(file=f"COLMAP's {place}", convention=Convention(W2C, OPENCV, world))
    return usual._replace(
        file=Path(file).name, convention=usual.convention._replace(room_from_world=world)
    )
