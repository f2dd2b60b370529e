"""Reads a room's files: nerfstudio-style transforms.json, its split files, or a COLMAP model.

The keys of a JSON are `frames`, camera keys (see Camera) for all frames, `floor_m`,
`floor_center_m` and `metres_per_unit`. The keys of a frame are `file_path`, `transform_matrix`,
`instance_path`, `mask_path`, and camera keys, which override the file's. Other keys are ignored,
and the pictures themselves are never opened.
"""

import contextlib
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from data_prep.posed.colmap import model_files, read_model
from data_prep.posed.recording import (
    Camera,
    Number,
    PosedFrame,
    Recording,
    check_one_png_a_frame,
    ids_path,
    path_text,
)
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.instances.checked import checked, number_array, shown

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


def room_files(folder: Path) -> list[Path]:
    """Files that the poses of a room are read from; empty if the folder is not a room.

    They are transforms.json; else transforms_*.json (one per split); else the files of a COLMAP
    model, with an optional transforms.json that has no frames but keys about the room.
    """
    whole = folder / FILE_NAME
    parts = sorted(folder.glob("transforms_*.json"))
    model = model_files(folder)
    if model is None or parts:
        return [whole] if whole.is_file() else parts
    if not whole.is_file():
        return [*model]
    try:
        data = read_json(whole)
    except InputError:
        return [whole]  # reading it will raise the error
    return [*model, whole] if isinstance(data, dict) and "frames" not in data else [whole]


def read_recording(folder: Path) -> Recording:
    """Read the frames of one room (`room_files`); errors name the file, the frame and the key."""
    files = room_files(Path(folder)) or [Path(folder) / FILE_NAME]
    jsons = [(path, read_json(path)) for path in files if path.suffix == ".json"]
    rooms = [(path, checked(_RoomEntry, data, str(path))) for path, data in jsons]
    model = [path for path in files if path.suffix != ".json"]
    frames: list[PosedFrame] = []
    if model:
        for image in read_model(model[0], model[1]):
            camera = checked(Camera, image.camera, f"{model[1]}, image {shown(image.name)}")
            ids = ids_path(Path(folder), image.name)
            frames.append(PosedFrame(image.name, image.camera_to_world, ids, None, camera))
        if not frames:
            raise InputError(f"{model[1]} has no image with a pose.")
    else:
        for path, data in jsons:
            frames += _frames(path, data)
    check_one_png_a_frame(files[0], tuple(frames))
    return Recording(
        Path(folder),
        files[0],
        tuple(frames),
        _one("floor_m", rooms),
        _one("floor_center_m", rooms),
        _one("metres_per_unit", rooms),
        leveled=not model,
    )


def _one(key: str, rooms: list[tuple[Path, _RoomEntry]]) -> Any:
    """Value of a key that all files of a room with this key must share; None if there is none."""
    said = [(path.name, getattr(room, key)) for path, room in rooms]
    said = [(name, value) for name, value in said if value is not None]
    for name, value in said[1:]:
        if value != said[0][1]:
            raise InputError(
                f"{rooms[0][0].parent}: {key} is {said[0][1]} in {said[0][0]}, but {value} in "
                f"{name}; a room has one."
            )
    return said[0][1] if said else None


def _frames(path: Path, data: dict[str, Any]) -> list[PosedFrame]:
    if not isinstance(data.get("frames"), list) or not data["frames"]:
        raise InputError(f"{path} has no list `frames` with a frame in it.")
    return [_frame(path, data, number) for number in range(len(data["frames"]))]


def _frame(path: Path, data: dict[str, Any], number: int) -> PosedFrame:
    item = data["frames"][number]
    if not isinstance(item, dict) or not isinstance(item.get("file_path"), str):
        raise InputError(f"{path}, frame {number}: it has no `file_path`.")
    name = item["file_path"]
    where = f"{path}, frame {shown(name)}"
    try:
        ids = ids_path(path.parent, name)
    except InputError as error:
        raise InputError(f"{path}, frame {number}: `file_path` {error}") from None
    own = {key: value for key, value in item.items() if value is not None}
    of_file = {key: data[key] for key in Camera.model_fields if data.get(key) is not None}
    entry = checked(_FrameEntry, of_file | own, where)
    return PosedFrame(
        name,
        _matrix(where, item.get("transform_matrix")),
        path.parent / entry.instance_path if entry.instance_path else ids,
        path.parent / entry.mask_path if entry.mask_path else None,
        entry,
    )


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
