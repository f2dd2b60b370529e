"""A user's own image: a PNG of ids, a table of classes and a lens in, an `ObservedImage` out."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.errors import InputError
from sceneprior.geometry.turns import QUARTERS, quarter_rotation
from sceneprior.instances.observations import observe
from sceneprior.instances.pngs import read_mask
from sceneprior.instances.tables import IdTable, read_class_table
from sceneprior.reconstruction.observed import ObservedImage

CAMERA_HEIGHT_M = 1.6
"""Of a camera whose pose nobody gave: the middle of what the recipes draw from, 1.4 to 1.8 m."""
CAMERA_DISTANCE_M = 1.5
"""How far from the middle of the room it stands, which it looks at."""


@dataclass(frozen=True)
class OwnImage:
    """What a user gave, in the room frame."""

    image: ObservedImage
    notes: tuple[str, ...]
    """What was assumed, or left out: sentences to print."""
    pose_known: bool


def read_own_image(
    mask: Path,
    classes: Path,
    intrinsics: str,
    label_set: str,
    pose: Path | None = None,
    camera_height_m: float = CAMERA_HEIGHT_M,
) -> OwnImage:
    """Read an image's masks and camera.

    Args:
        mask: PNG of one channel; equal values are one object, 0 is nothing.
        classes: JSON or CSV: the class of each value. Classes outside the label set are void.
        intrinsics: `fx,fy,cx,cy` in pixels of the mask, or a JSON file; see `read_intrinsics`.
        label_set: The run's.
        pose: JSON; see `read_pose`. Without one the camera is level, `camera_height_m` above the
            floor and `CAMERA_DISTANCE_M` before the middle of the room, looking along -z.
        camera_height_m: Of a camera without a pose.

    Raises:
        InputError: a file cannot be used, the sizes differ, or no object is seen.
    """
    values = read_mask(mask)
    height, width = values.shape
    table = IdTable(read_class_table(classes), label_set, str(classes))
    lens = read_intrinsics(intrinsics, (height, width))
    seen = observe(table.ids(values)[None], table.is_object)
    if not len(seen.tracked):
        raise InputError(
            f"{mask} shows no object: none of its masks is of a class of the run and wider than "
            f"4 pixels. Its values are {_some(np.unique(values))}; {classes} says what they are."
        )
    notes = list(table.notes)
    if table.unlisted - {0}:
        notes.append(
            f"{mask} has values that {classes} does not list, taken for void: "
            f"{_some(np.array(sorted(table.unlisted)))}"
        )
    if pose is None:
        notes.append(
            f"without --pose the camera is level, {camera_height_m:g} m above the floor and "
            f"{CAMERA_DISTANCE_M:g} m from the middle of the room, which it looks at"
        )
    image = ObservedImage(
        name=mask.stem,
        label_set=label_set,
        object_class=table.classes[seen.tracked].astype(np.int64),
        instance_ids=seen.instance_ids[0],
        boxes=seen.boxes[0],
        sides_clear=seen.sides_clear[0],
        world_to_camera=level_camera(camera_height_m) if pose is None else read_pose(pose),
        intrinsics=lens,
    )
    return OwnImage(image, tuple(notes), pose is not None)


def _some(values: np.ndarray) -> str:
    return ", ".join(str(value) for value in values[:8]) + (", ..." if len(values) > 8 else "")


def level_camera(height_m: float, quarter: int = 0) -> np.ndarray:
    """`world_to_camera` of a level camera that looks through the middle of the room.

    Args:
        height_m: Above the floor.
        quarter: 0 stands on the +z side and looks along -z; each quarter goes on about +y.
    """
    turn = quarter_rotation(quarter)
    eye = turn @ np.array([0, height_m, CAMERA_DISTANCE_M])
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0]) @ turn.T  # OpenCV: y down, z into the room
    pose[:3, 3] = -pose[:3, :3] @ eye
    return pose


def sides_of_room(own: OwnImage, camera_height_m: float) -> list[ObservedImage]:
    """The image itself; without a pose, as seen from each of the room's four sides."""
    if own.pose_known:
        return [own.image]
    return [
        replace(own.image, world_to_camera=level_camera(camera_height_m, quarter))
        for quarter in range(QUARTERS)
    ]


def read_intrinsics(text: str, image_size: tuple[int, int]) -> np.ndarray:
    """A lens: `fx,fy,cx,cy`, or a JSON file with `K` (3 x 3), or `fx`, `fy`, `cx` and `cy`.

    The file may say of which image (`width`, `height`), which is checked.

    Raises:
        InputError: neither; not finite; or of an image of another size.
    """
    expected = 'fx,fy,cx,cy in pixels, or a JSON file: {"fx": 240, "fy": 240, "cx": 240, "cy": 180}'
    path = Path(text)
    if path.suffix.lower() == ".json":
        data = _read_json(path)
        if not isinstance(data, dict):
            data = {"K": data}
        said = (data.get("height", image_size[0]), data.get("width", image_size[1]))
        if said != image_size:
            raise InputError(
                f"{path} is of an image of {said[1]} x {said[0]} pixels, but the mask has "
                f"{image_size[1]} x {image_size[0]}; scale fx, fy, cx and cy, or the mask."
            )
        try:
            lens = np.array(
                data["K"]
                if "K" in data
                else [[data["fx"], 0, data["cx"]], [0, data["fy"], data["cy"]], [0, 0, 1]],
                dtype=np.float64,
            )
        except (KeyError, TypeError, ValueError):
            raise InputError(f"{path} holds no lens; expected {expected}.") from None
    else:
        try:
            fx, fy, cx, cy = (float(value) for value in text.split(","))
        except ValueError:
            raise InputError(f"--intrinsics {text} is no lens; expected {expected}.") from None
        lens = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    plain = (
        lens.shape == (3, 3)
        and np.isfinite(lens).all()
        and min(lens[0, 0], lens[1, 1]) > 0
        and lens[0, 1] == 0
        and np.allclose(lens[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1])
    )
    if not plain:
        raise InputError(
            f"--intrinsics {text} is no pinhole lens (fx and fy above 0, no skew); "
            f"expected {expected}."
        )
    return lens


def read_pose(path: Path) -> np.ndarray:
    """`world_to_camera` from a JSON file: that key, or `camera_to_world`; 4 x 4, OpenCV axes.

    The world is the room frame: metres, y up, the floor y = 0 and its middle the origin.

    Raises:
        InputError: there is no such matrix, or it is no rotation with a translation.
    """
    data = _read_json(path)
    found: list[str] = []
    try:
        found = [key for key in ("world_to_camera", "camera_to_world") if key in data]
        matrix = np.array(data[found[0]], dtype=np.float64)
        turn = matrix[:3, :3]
        rigid = (
            matrix.shape == (4, 4)
            and np.isfinite(matrix).all()
            and np.allclose(turn @ turn.T, np.eye(3), atol=1e-3)
            and np.linalg.det(turn) > 0
            and np.allclose(matrix[3], [0, 0, 0, 1])
        )
    except (IndexError, KeyError, TypeError, ValueError):
        rigid = False
    if not rigid:
        raise InputError(
            f'{path} holds no pose; expected {{"world_to_camera": 4 x 4}} or '
            '{"camera_to_world": 4 x 4}, a rotation and a translation in metres, camera axes x '
            "right, y down, z forward, in a room with y up and the floor at 0."
        )
    return matrix if found[0] == "world_to_camera" else np.linalg.inv(matrix)


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} cannot be read as JSON ({str(error)[:120]}).") from None
