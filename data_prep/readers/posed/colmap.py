"""Reads COLMAP's models, binary or text: cameras and poses of images, without the points.

Source: COLMAP's documentation of its output format, and `src/colmap/sensor/models.h`.
"""

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy.spatial.transform import Rotation

from data_prep.readers.posed.recording import Camera, PosedPicture
from sceneprior.core.checked import checked, plain, shown
from sceneprior.core.errors import InputError

FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")
"""Folders in which COLMAP or nerfstudio put a model."""
_MODELS = {
    0: ("SIMPLE_PINHOLE", "f cx cy"),
    1: ("PINHOLE", "fl_x fl_y cx cy"),
    2: ("SIMPLE_RADIAL", "f cx cy k1"),
    3: ("RADIAL", "f cx cy k1 k2"),
    4: ("OPENCV", "fl_x fl_y cx cy k1 k2 p1 p2"),
    5: ("OPENCV_FISHEYE", "fl_x fl_y cx cy k1 k2 k3 k4"),
    8: ("SIMPLE_RADIAL_FISHEYE", "f cx cy k1"),
    9: ("RADIAL_FISHEYE", "f cx cy k1 k2"),
}
"""Name and parameters of a camera model by COLMAP's number. Parameters have their names in
transforms.json; `f` stands for both focal lengths."""
_BYTES_A_POINT = 24
_LONGEST_NAME = 4096


def model_files(folder: Path) -> tuple[Path, Path] | None:
    """Find a model's files of cameras and of images, preferably binary; None without a model."""
    for name in FOLDERS:
        for ending in ("bin", "txt"):
            paths = (folder / name / f"cameras.{ending}", folder / name / f"images.{ending}")
            if all(path.is_file() for path in paths):
                return paths
    return None


def read_model(cameras: Path, images: Path) -> list[PosedPicture]:
    """Read the images of a model, sorted by name."""
    binary = cameras.suffix == ".bin"
    try:
        known = dict((_binary_cameras if binary else _text_cameras)(cameras))
        rows = list((_binary_images if binary else _text_images)(images))
        made = [
            PosedPicture(
                name,
                _camera_to_world(pose),
                checked(Camera, known[camera], f"{images}, image {shown(name)}"),
            )
            for name, pose, camera in rows
        ]
    except KeyError as error:
        raise InputError(f"{images} names camera {error}, which {cameras.name} lacks.") from None
    except (OSError, ValueError, IndexError, struct.error, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(
            f"{cameras.parent} holds no COLMAP model that can be read ({plain(str(error), 120)})."
        ) from None
    if not made:
        raise InputError(f"{images} has no image with a pose.")
    return sorted(made, key=lambda image: image.name)


def _camera(path: Path, model: str, size: tuple[int, int], values: list[float]) -> dict[str, Any]:
    names = next((text.split() for name, text in _MODELS.values() if name == model), None)
    if names is None:
        raise InputError(
            f"{path}: its camera model {plain(model)} is not supported; use `colmap "
            "image_undistorter` to make pinhole pictures and a model of them (and make masks of "
            "those pictures), or reconstruct again with OPENCV or OPENCV_FISHEYE."
        )
    if len(values) != len(names):
        raise ValueError(f"{plain(model)} has {len(names)} parameters, not {len(values)}")
    keys = dict(zip(names, values, strict=True))
    if "f" in keys:
        keys["fl_x"] = keys["fl_y"] = keys.pop("f")
    return {"camera_model": model, "w": size[0], "h": size[1], **keys}


def _camera_to_world(pose: list[float]) -> np.ndarray:
    """Camera-to-world matrix (OpenGL axes) of COLMAP's pose.

    COLMAP stores the world-to-camera rotation as a quaternion (w, x, y, z), then the translation,
    for OpenCV axes.
    """
    matrix = np.eye(4)
    w, x, y, z = pose[:4]
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix().T
    matrix[:3, 3] = -matrix[:3, :3] @ pose[4:]
    return matrix @ np.diag([1.0, -1, -1, 1])


def _text_rows(path: Path) -> list[str]:
    lines = path.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if not line.startswith("#")]


def _text_cameras(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    for line in _text_rows(path):
        if words := line.split():
            values = [float(word) for word in words[4:]]
            size = int(words[2]), int(words[3])
            yield int(words[0]), _camera(path, words[1], size, values)


def _text_images(path: Path) -> Iterator[tuple[str, list[float], int]]:
    # Each image has a second line with its points, which may be empty.
    for line in _text_rows(path)[::2]:
        if line.strip():
            words = line.split(maxsplit=9)
            yield words[9], [float(word) for word in words[1:8]], int(words[8])


def _take(file: BinaryIO, form: str) -> tuple[Any, ...]:
    return struct.unpack(f"<{form}", file.read(struct.calcsize(f"<{form}")))


def _binary_cameras(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    with path.open("rb") as file:
        for _ in range(_take(file, "Q")[0]):
            number, model, width, height = _take(file, "iiQQ")
            if model not in _MODELS:
                yield number, _camera(path, f"number {model}", (width, height), [])
            name, keys = _MODELS[model]
            values = [*_take(file, f"{len(keys.split())}d")]
            yield number, _camera(path, name, (width, height), values)


def _binary_images(path: Path) -> Iterator[tuple[str, list[float], int]]:
    with path.open("rb") as file:
        for _ in range(_take(file, "Q")[0]):
            _, *pose, camera = _take(file, "i7di")
            name = bytearray()
            while (letter := file.read(1)) not in (b"\0", b"") and len(name) < _LONGEST_NAME:
                name += letter
            (points,) = _take(file, "Q")
            file.seek(points * _BYTES_A_POINT, 1)
            yield name.decode(), pose, camera
