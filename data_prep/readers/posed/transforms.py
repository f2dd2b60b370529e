"""Reads a room's poses: nerfstudio-style transforms.json, its split files, or other tools' files.

The keys of a JSON are `frames`, camera keys (see Camera) for all frames, `floor_m`,
`floor_center_m` and `metres_per_unit`. The keys of a frame are `file_path`, `transform_matrix`,
`instance_path`, `mask_path`, and camera keys, which override the file's. Other keys are ignored,
and the pictures themselves are never opened. If the poses come from another tool, only the keys
about the room are read.
"""

import contextlib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from data_prep.readers.posed.cameras import Camera, Number
from data_prep.readers.posed.captures import TOOLS, choose_model
from data_prep.readers.posed.recording import (
    INSTANCES,
    PosedFrame,
    Recording,
    as_png,
    ids_path,
    path_text,
)
from sceneprior.core.checked import checked, number_array, shown
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_files, read_json

FILE_NAME = "transforms.json"

PathText = Annotated[str, AfterValidator(path_text)]


class _FrameEntry(Camera):
    instance_path: PathText | None = None
    mask_path: PathText | None = None


class _RoomEntry(BaseModel):
    model_config = ConfigDict(strict=True)

    floor_m: Number | None = None
    floor_center_m: Annotated[tuple[Number, Number], Field(strict=False)] | None = None
    metres_per_unit: Annotated[Number, Field(gt=0)] | None = None


POSES = {
    "nerfstudio": f"nerfstudio ({FILE_NAME})",
    **{name: tool.title for name, tool in TOOLS.items()},
}
"""Formats of poses: the value of `--from`, and the tool's name with its files."""


def pose_files(folder: Path, given: str | None = None) -> tuple[str, list[Path]]:
    """Format of a room's poses, and their files.

    The list is empty if the folder is not a room. If `given` is None, the format is guessed:
    transforms.json, or else transforms_*.json (one per split), is preferred to a COLMAP model,
    because nerfstudio writes it beside that model. Poses of other tools may come with a
    transforms.json that has keys about the room but no frames.
    """
    whole = folder / FILE_NAME
    of_room = [whole] if whole.is_file() else []
    found = {
        name: [*files, *of_room] for name, tool in TOOLS.items() if (files := tool.find(folder))
    }
    own = of_room or list_files(folder, "transforms_*.json")
    if own:
        data: Any = None
        with contextlib.suppress(InputError):  # reading it will raise the error
            data = read_json(whole) if of_room and found else None
        if not isinstance(data, dict) or "frames" in data:
            found["nerfstudio"] = own
            if given != "colmap":
                found.pop("colmap", None)
    if given is not None:
        return given, found.get(given, [])
    if len(found) > 1:
        raise InputError(
            f"{folder} has poses of {' and of '.join(POSES[name] for name in sorted(found))}; "
            f"choose with --from {' or --from '.join(sorted(found))}."
        )
    return next(iter(found.items()), ("nerfstudio", []))


def read_recording(folder: Path, given: str | None = None, model: int | None = None) -> Recording:
    """Read the frames of one room (`pose_files`); errors name the file, the frame and the key.

    `model` is the number of one of COLMAP's models; None takes the largest.
    """
    folder = Path(folder)
    name, files = pose_files(folder, given)
    if not files and name != "nerfstudio":
        raise InputError(f"{folder} has no poses of {POSES[name]}; leave out --from to guess.")
    files = files or [folder / FILE_NAME]
    jsons = [(path, read_json(path)) for path in files if name == "nerfstudio"]
    rooms = jsons or [(path, read_json(path)) for path in files if path == folder / FILE_NAME]
    of_room = [(path, checked(_RoomEntry, data, str(path))) for path, data in rooms]
    notes: tuple[str, ...] = ()
    if name == "nerfstudio":
        tool, frames = None, _frames(jsons)
    else:
        tool = TOOLS[name]
        files = [path for path in files if path != folder / FILE_NAME]
        if name == "colmap":
            files, notes = choose_model(files, model)
        read = tool.read(files)
        frames = [frame._replace(instances=ids_path(folder, frame.name)) for frame in read]
    first: dict[Path, str] = {}
    for frame in frames:
        other = first.setdefault(frame.instances, frame.name)
        if other is not frame.name:
            raise InputError(
                f"{files[0]}: frames {shown(other)} and {shown(frame.name)} would share the ids in "
                f"{frame.instances}; store the ids in the same folders as the frames: "
                f"{INSTANCES}/{as_png(other)}."
            )
    metres_per_unit = _one("metres_per_unit", of_room)
    if metres_per_unit is None and tool is not None and tool.in_metres:
        metres_per_unit = 1.0
    return Recording(
        folder,
        files[0],
        tuple(frames),
        _one("floor_m", of_room),
        _one("floor_center_m", of_room),
        metres_per_unit,
        notes,
        "z" if tool is None else tool.up,
    )


def _one(key: str, rooms: list[tuple[Path, _RoomEntry]]) -> Any:
    """Value of a key, which all files of a room that have the key must share; None if none has."""
    said = [(path.name, getattr(room, key)) for path, room in rooms]
    said = [(name, value) for name, value in said if value is not None]
    for name, value in said[1:]:
        if value != said[0][1]:
            raise InputError(
                f"{rooms[0][0].parent}: {key} is {said[0][1]} in {said[0][0]}, but {value} in "
                f"{name}; a room has one."
            )
    return said[0][1] if said else None


def _frames(jsons: list[tuple[Path, Any]]) -> list[PosedFrame]:
    """The frames of a room's JSONs."""
    frames = []
    for path, data in jsons:
        if not isinstance(data.get("frames"), list) or not data["frames"]:
            raise InputError(f"{path} has no list `frames` with a frame in it.")
        of_file = {key: data[key] for key in Camera.model_fields if data.get(key) is not None}
        for number, item in enumerate(data["frames"]):
            where = f"{path}, frame {number}"
            if not isinstance(item, dict) or not isinstance(item.get("file_path"), str):
                raise InputError(f"{where}: it has no `file_path`.")
            name = item["file_path"]
            try:
                ids = ids_path(path.parent, name)
            except InputError as error:
                raise InputError(f"{where}: `file_path` {error}") from None
            where = f"{path}, frame {shown(name)}"
            own = {key: value for key, value in item.items() if value is not None}
            entry = checked(_FrameEntry, of_file | own, where)
            frames.append(
                PosedFrame(
                    name,
                    _matrix(where, item.get("transform_matrix")),
                    entry,
                    path.parent / entry.instance_path if entry.instance_path else ids,
                    path.parent / entry.mask_path if entry.mask_path else None,
                )
            )
    return frames


def _matrix(where: str, value: Any) -> np.ndarray:
    """Parse a (4, 4) matrix, which may lack its last row. NaN (a lost pose) is allowed."""
    matrix = np.zeros(0)
    with contextlib.suppress(TypeError, ValueError):
        matrix = number_array(value)
    if matrix.shape == (3, 4):
        matrix = np.concatenate([matrix, [[0, 0, 0, 1]]])
    if matrix.shape != (4, 4):
        raise InputError(f"{where}: `transform_matrix` is not a list of 4 rows of 4 numbers.")
    return matrix
