"""Read an image of the user: its masks, their classes, and the camera."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sceneprior.core.boxes import QUARTERS, quarter_rotation
from sceneprior.core.cameras import camera_at, camera_centers, odd_field_of_view
from sceneprior.core.checked import number_array
from sceneprior.core.classes import label_set
from sceneprior.core.coco import read_coco
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.id_tables import IdTable, read_class_table, read_mask, tidy
from sceneprior.core.observations import observe, thinned, thinned_intrinsics
from sceneprior.core.views import ObservedImage

SAME_CLASS = {
    "bed": "double bed",
    "bookcase": "bookshelf",
    "closet": "wardrobe",
    "couch": "sofa",
    "dining chair": "chair",
    "dining table": "table",
    "double bed": "bed",
    "night stand": "nightstand",
    "nightstand": "night stand",
    "office chair": "chair",
    "refrigerator": "refridgerator",
    "shelf": "shelves",
    "shelves": "shelf",
    "single bed": "bed",
    "tv": "television",
}
"""Maps class names of other data sets (COCO, ADE20K) to names that a label set may have instead."""
CAMERA_HEIGHTS_M = (1.0, 1.2, 1.4, 1.6, 1.8)
"""Camera heights that are tried if no pose is given, from a sitting to a standing photographer."""
LARGEST_PX = 640
"""Longest side of an image in pixels, as in training images; larger images are subsampled."""
FILM_DIAGONAL_MM = math.hypot(36, 24)
UPSIDE_DOWN = 0.1
"""Largest upward component of a camera's y axis (a sine); cameras above it are refused as upside
down. Cameras that look straight down or up are accepted."""
CAMERA_DISTANCE_M = 1.5
"""Horizontal distance of the assumed camera from the middle of the room, which it faces."""


class OwnImage(NamedTuple):
    """The user's image, with its camera in the room frame."""

    images: list[ObservedImage]
    """The image; without a pose, one copy per assumed height and side of the room."""
    notes: list[str]
    """Sentences to print on assumptions and omissions."""


def read_own_image(
    mask: Path,
    classes: Path | None,
    intrinsics: str,
    label_set_name: str,
    pose: Path | None = None,
    camera_height_m: float | None = None,
    sides: int = QUARTERS,
    gravity: str | None = None,
) -> OwnImage:
    """Read an image's masks and camera.

    Classes outside the run's label set are replaced by `SAME_CLASS`, or else by void.

    Args:
        mask: A PNG of ids, or COCO's JSON, which also has the classes.
        pose: File for `read_pose`. None assumes a camera at one of `sides` of the room, at the
            given height or at all `CAMERA_HEIGHTS_M`, tilted by `gravity` (level by default).
    """
    if mask.suffix.lower() == ".json":
        if classes is not None:
            raise InputError(f"{mask} already lists its classes; leave out --classes {classes}.")
        values, of_id = read_coco(mask)
        classes = mask
    elif classes is None:
        raise InputError(f"{mask} needs --classes: a table of the class of each of its values.")
    else:
        values, of_id = read_mask(mask), read_class_table(classes)
    of_id, notes = _known_by_another_name(of_id, label_set_name)
    table = IdTable(of_id, label_set_name, str(classes))
    camera = read_intrinsics(intrinsics, values.shape)
    step = -(-max(values.shape) // LARGEST_PX)
    seen = observe(table.ids(values[thinned(step)])[None], table.classes)
    camera = thinned_intrinsics(camera, step)
    if not len(seen.tracked):
        raise InputError(
            f"{mask} shows no object: none of its masks is wider than 4 pixels and has a class of "
            f"the run. Its values are {_some(np.unique(values))}; {classes} lists their classes."
        )
    notes += table.notes
    if table.unlisted:
        notes.append(
            f"{mask} has values that {classes} does not list, taken for void: "
            f"{_some(sorted(table.unlisted))}"
        )
    if pose is None:
        heights_m = CAMERA_HEIGHTS_M if camera_height_m is None else (camera_height_m,)
        told = " or ".join(f"{height_m:g}" for height_m in heights_m)
        notes.append(
            f"without --pose the camera is {'level' if gravity is None else 'tilted as given'}, "
            f"{told} m above the floor (the best fit is kept) and {CAMERA_DISTANCE_M:g} m from "
            "the middle of the room, which it faces"
        )
        if gravity is None:
            notes.append(
                "a level camera is a guess: for cameras that look down by 13 degrees (median), it "
                "displaced objects by 34 cm (by 1.1 m with --camera-height), and --gravity by 7 "
                "cm; give --gravity x,y,z from the phone's accelerometer, or --pose"
            )
        tilt = np.eye(4) if gravity is None else read_gravity(gravity)
        poses = [tilt @ level_camera(height, side) for height in heights_m for side in range(sides)]
    else:
        poses = [read_pose(pose)]
    images = [
        ObservedImage(
            name=mask.stem,
            label_set=label_set_name,
            object_class=seen.object_class.astype(np.int64),
            instance_ids=seen.instance_ids[0],
            boxes=seen.boxes[0],
            sides_clear=seen.sides_clear[0],
            world_to_camera=world_to_camera,
            intrinsics=camera,
        )
        for world_to_camera in poses
    ]
    return OwnImage(images, notes)


def _known_by_another_name(
    of_id: dict[int, str], label_set_name: str
) -> tuple[dict[int, str], list[str]]:
    """Rename classes to those of the label set by `SAME_CLASS`; also return notes on these."""
    known = {tidy(name) for name in label_set(label_set_name)}
    taken: Counter[tuple[str, str]] = Counter()
    for key, name in of_id.items():
        other = SAME_CLASS.get(tidy(name))
        if tidy(name) not in known and other in known:
            taken[name, other] += 1
            of_id = of_id | {key: other}
    return of_id, [
        f"the label set has no class {name}: taken for {other} ({count})"
        for (name, other), count in sorted(taken.items())
    ]


def _some(values: Sequence[int] | np.ndarray) -> str:
    return ", ".join(str(value) for value in values[:8]) + (", ..." if len(values) > 8 else "")


def level_camera(height_m: float, quarter: int = 0) -> np.ndarray:
    """`world_to_camera` of a level camera at height `height_m`, facing the middle of the room.

    The horizontal distance to the middle is `CAMERA_DISTANCE_M`. With `quarter` 0 the camera is on
    the +z side and looks along -z; each quarter turns it about +y.
    """
    turn = quarter_rotation(quarter)
    eye = turn @ np.array([0, height_m, CAMERA_DISTANCE_M])
    return camera_at(np.diag([1.0, -1.0, -1.0]) @ turn.T, eye)  # OpenCV: y down, z into the room


def read_gravity(text: str) -> np.ndarray:
    """(4, 4) transform that tilts a level camera: the smallest rotation from +y to gravity.

    `text` is gravity's direction in camera axes (x right, y down, z forward), `x,y,z` of any
    length. The transform is applied after the level camera's `world_to_camera`.

    >>> (read_gravity("0,1.5,2")[:3, :3] @ [0, 1, 0]).round(6).tolist()
    [0.0, 0.6, 0.8]
    """
    try:
        down = np.array([float(part) for part in text.split(",")])
    except ValueError:
        down = np.zeros(0)
    if down.shape != (3,) or not np.isfinite(down).all() or not down.any():
        raise InputError(
            f"--gravity {text} is not a direction; expected x,y,z in camera axes (x right, y down, "
            "z forward): 0,1,0 for a level camera, 0,0.9,0.4 for one that looks down a little."
        )
    x, y, z = down / np.linalg.norm(down)
    if y < -UPSIDE_DOWN:
        raise InputError(
            f"--gravity {text} points up in the image: the camera is upside down. Expected camera "
            "axes x right, y down, z forward."
        )
    # Rodrigues' formula for rotating (0, 1, 0) to gravity about their common normal, (z, 0, -x).
    cross = np.array([[0, x, 0], [-x, 0, -z], [0, z, 0]])
    pose = np.eye(4)
    pose[:3, :3] += cross + cross @ cross / (1 + y)
    return pose


def read_intrinsics(text: str, image_size: tuple[int, int]) -> np.ndarray:
    """Read intrinsics: `fov=73`, `35mm=26`, `fx,fy,cx,cy`, or a JSON file with `K` (3 x 3), or
    with `fx`, `fy`, `cx` and `cy`.

    `fov` is the horizontal field of view in degrees, `35mm` the 35 mm equivalent focal length in
    millimetres, by the diagonal; for both the principal point is the image centre. A file may state
    the size of its image (`width`, `height`), which is checked.
    """
    expected = (
        "fx,fy,cx,cy in pixels, fov=DEGREES, 35mm=MILLIMETRES, or a JSON file: "
        '{"fx": 240, "fy": 240, "cx": 240, "cy": 180}'
    )
    path, (height, width) = Path(text), image_size
    in_file = path.suffix.lower() == ".json"
    data: Any
    try:
        if in_file:
            data = read_json(path)
            data = data if isinstance(data, dict) else {"K": data}
            said = (data.get("height", height), data.get("width", width))
            if said != image_size:
                raise InputError(
                    f"{path} is for an image of {said[1]} x {said[0]} pixels, but the mask has "
                    f"{width} x {height}; scale fx, fy, cx and cy, or the mask."
                )
        elif text.startswith(("fov=", "35mm=")):
            kind, _, number = text.partition("=")
            value = float(number)
            if kind == "35mm":
                focal = value * math.hypot(*image_size) / FILM_DIAGONAL_MM
            elif 0 < value < math.pi:
                raise InputError(
                    f"--intrinsics {text}: no camera has so small a field of view. If {number} is "
                    f"in radians, give degrees: fov={math.degrees(value):.3g}."
                )
            elif 0 < value < 180:
                focal = width / 2 / math.tan(math.radians(value) / 2)
            else:
                raise ValueError("no field of view")
            data = {"fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2}
        else:
            data = dict(zip(("fx", "fy", "cx", "cy"), map(float, text.split(",")), strict=True))
        if "K" not in data:
            fx, fy, cx, cy = (data[key] for key in ("fx", "fy", "cx", "cy"))
            data = {"K": [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]}
        matrix = number_array(data["K"])
    except InputError:
        raise
    except (KeyError, TypeError, ValueError):
        source = f"{path} holds" if in_file else f"--intrinsics {text} gives"
        raise InputError(f"{source} no intrinsics; expected {expected}.") from None
    pinhole = (
        matrix.shape == (3, 3)
        and np.isfinite(matrix).all()
        and min(matrix[0, 0], matrix[1, 1]) > 0
        and matrix[0, 1] == 0
        and np.allclose(matrix[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1])
    )
    if not pinhole:
        raise InputError(
            f"--intrinsics {text} is not a pinhole camera (fx and fy above 0, no skew); "
            f"expected {expected}."
        )
    for focal in (matrix[0, 0], matrix[1, 1]):
        if odd := odd_field_of_view(focal, image_size):
            raise InputError(f"--intrinsics {text}: {odd}.")
    if not (0 <= matrix[0, 2] <= width and 0 <= matrix[1, 2] <= height):
        raise InputError(
            f"The middle of the camera's image, cx = {matrix[0, 2]:g} and cy = {matrix[1, 2]:g}, "
            f"is outside the mask of {width} x {height} pixels; --intrinsics {text} is for an "
            "image of another size. Scale the intrinsics, or the mask."
        )
    return matrix


def read_pose(path: Path) -> np.ndarray:
    """The 4 x 4 `world_to_camera` of a JSON's key `world_to_camera` or `camera_to_world`.

    Axes are OpenCV's; the world is the room frame, whose origin is the middle of the floor.
    """
    data = read_json(path)
    try:
        key = "world_to_camera" if "world_to_camera" in data else "camera_to_world"
        matrix = number_array(data[key])
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
    pose = matrix if key == "world_to_camera" else np.linalg.inv(matrix)
    if pose[1, 1] > UPSIDE_DOWN:
        raise InputError(
            f"The camera of {path} is upside down: the room's y axis points down in its image. "
            "Expected camera axes x right, y down, z forward (OpenCV; Blender's and OpenGL's have "
            "y up and look along -z), and a room with y up."
        )
    eye_m = camera_centers(pose)
    if eye_m[1] <= 0:
        raise InputError(
            f"The camera of {path} is {abs(eye_m[1]):g} m below the floor, which is y = 0; move "
            "it, or turn the room so that y is up."
        )
    return pose
