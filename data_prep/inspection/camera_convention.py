"""The files that a room's cameras were read from, and the convention of the matrices in them."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from data_prep.engine.plan import in_words
from data_prep.engine.report import REPORT_NAME
from data_prep.engine.source import Line
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json

Axes = tuple[tuple[int, ...], ...]
"""A camera's x, y and z axes as rows, each with its components to the right, down and forward."""
OPENCV: Axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
OPENGL: Axes = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
C2W, W2C, TURNED, MOVED = "c2w", "w2c", "turned", "moved"
"""Possible contents of a matrix: camera to world; world to camera; the camera's position with the
rotation from world to camera; the translation to the camera with the rotation from camera to
world."""


class Convention(NamedTuple):
    """Convention of the matrices that a room's cameras were read from, and the file's name."""

    file: str = "the shards (`world_to_camera`)"
    """Name for messages: transforms.json."""
    reading: str = W2C
    axes: Axes = OPENCV
    room_from_world: np.ndarray = np.eye(4)
    """(4, 4) rigid, from the world of the matrices (in metres) to the room."""
    posed: bool = False
    """True for rooms of prep-posed, whose options the messages may name."""


_OF_SOURCE = {
    "posed": Convention("the file of poses", C2W, OPENGL, posed=True),
    "scannet": Convention("the scans' .sens files", C2W, OPENCV),
}
_COLMAP = ("cameras.bin", "cameras.txt")


class Conventions(NamedTuple):
    """Conventions of all rooms of a folder."""

    usual: Convention
    """That of the folder's source."""
    rooms: dict[str, Convention]
    """Those of rooms whose file the report names, by id."""

    def of(self, room_id: str) -> Convention:
        """Convention of one room."""
        return self.rooms.get(room_id, self.usual)


def read_conventions(folder: Path, source: Any) -> tuple[Conventions, str | None]:
    """Conventions of a folder whose index.json names `source`; and a sentence if more rooms failed
    than were prepared.

    The report states the origin of a room's poses (`PreparedRoom.cameras`). If the report is
    missing or from an earlier release, the usual convention of the source is assumed.
    """
    usual = _OF_SOURCE.get(str(source), Convention())
    try:
        lines = [Line(**line) for line in read_json(folder / REPORT_NAME)["rooms"]]
        rooms = {line.room_id: _stated(usual, **line.cameras) for line in lines if line.cameras}
    except (InputError, KeyError, TypeError, ValueError):
        return Conventions(usual, {}), None
    failed = [line for line in lines if line.status == "failed"]
    prepared = sum(line.status == "prepared" for line in lines)
    said = f"{len(lines)} rooms, {prepared} prepared: {in_words(failed)}"
    return Conventions(usual, rooms), said if len(failed) > prepared else None


def _stated(usual: Convention, file: str, room_from_world: list[list[float]]) -> Convention:
    world = np.array(room_from_world, dtype=np.float64).reshape(4, 4)
    if Path(file).name in _COLMAP:
        name = f"COLMAP's {Path(file).parent.as_posix()}"
        return usual._replace(file=name, reading=W2C, axes=OPENCV, room_from_world=world)
    return usual._replace(file=Path(file).name, room_from_world=world)
