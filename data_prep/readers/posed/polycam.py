"""Reads the poses of Polycam's raw data: one JSON per keyframe.

Source: the README and `polyform/core/capture_folder.py` of PolyCam/polyform. Poses are camera to
world, in metres, with OpenGL axes in ARKit's world, whose y points up.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict

from data_prep.readers.posed.recording import Camera, Number
from sceneprior.core.checked import checked
from sceneprior.core.files import read_json

KEYFRAMES = ("keyframes/corrected_cameras", "keyframes/cameras")
"""Folders of optimized poses, for undistorted pictures, and of ARKit's poses, for originals."""


class _Keyframe(BaseModel):
    model_config = ConfigDict(strict=True)

    fx: Number
    fy: Number
    cx: Number
    cy: Number
    width: Number
    height: Number
    t_00: float
    t_01: float
    t_02: float
    t_03: float
    t_10: float
    t_11: float
    t_12: float
    t_13: float
    t_20: float
    t_21: float
    t_22: float
    t_23: float


def polycam_files(folder: Path) -> list[Path]:
    """The JSONs of a raw export's keyframes, preferably the optimized ones; empty without any."""
    for name in KEYFRAMES:
        if paths := sorted((folder / name).glob("*.json")):
            return paths
    return []


def read_keyframes(paths: list[Path]) -> Iterator[tuple[str, np.ndarray, Camera]]:
    """Name of the picture, camera-to-world matrix (4, 4) and camera of each keyframe."""
    for path in paths:
        read = checked(_Keyframe, read_json(path), str(path))
        rows = [[getattr(read, f"t_{row}{column}") for column in range(4)] for row in range(3)]
        pictures = path.parent.name.replace("cameras", "images")
        yield (
            f"keyframes/{pictures}/{path.stem}.jpg",
            np.array([*rows, [0, 0, 0, 1.0]]),
            Camera(fl_x=read.fx, fl_y=read.fy, cx=read.cx, cy=read.cy, w=read.width, h=read.height),
        )
