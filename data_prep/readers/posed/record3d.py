"""Reads the poses of a Record3D recording from its JSON `metadata`.

Source: the author's answers in the issues of marek-simonik/record3d (27, 33, 36, 83, 93), and
`scripts/record3d2nerf.py` in NVlabs/instant-ngp. Poses are camera to world, in metres, with OpenGL
axes, relative to the first camera, so no axis of their world points up. nerfstudio's reader moves
the principal point to the image centre; here it stays as written.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field
from scipy.spatial.transform import Rotation

from data_prep.readers.posed.recording import Camera, Number
from sceneprior.core.checked import checked
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json

FILES = ("metadata", "metadata.json", "EXR_RGBD/metadata", "EXR_RGBD/metadata.json")
"""Names of the JSON in an unpacked .r3d file, and in an export of EXRs and pictures."""
_POSES = b'"poses"'
_OFF = 0.01
"""Largest deviation of a quaternion's length from 1."""


class _Metadata(BaseModel):
    poses: list[Annotated[list[float], Field(min_length=7, max_length=7)]]
    """Rotation as a quaternion x, y, z, w, then the position."""
    K: Annotated[list[Number], Field(min_length=9, max_length=9)]
    """Intrinsics (3, 3) of the first frame, column by column."""
    perFrameIntrinsicCoeffs: list[Annotated[list[Number], Field(min_length=4)]] | None = None  # noqa: N815
    """fx, fy, cx, cy of each frame."""
    w: Number
    h: Number


def record3d_files(folder: Path) -> list[Path]:
    """The JSON of a recording; empty if there is none. A file without poses is ignored."""
    for name in FILES:
        path = folder / name
        if path.is_file() and _POSES in path.read_bytes():
            return [path]
    return []


def read_metadata(path: Path) -> Iterator[tuple[str, np.ndarray, Camera]]:
    """Name of the picture, camera-to-world matrix (4, 4) and camera of each frame."""
    read = checked(_Metadata, read_json(path), str(path))
    poses = np.array(read.poses).reshape(-1, 7)
    if not len(poses):
        raise InputError(f"{path} has no poses; expected one for each picture.")
    if len(poses) > 1 and np.allclose(poses, [0, 0, 0, 1, 0, 0, 0]):
        raise InputError(
            f"{path}: all its poses are the identity, as those of the selfie camera, which have "
            "none; record with the LiDAR camera."
        )
    K = read.K
    lenses = read.perFrameIntrinsicCoeffs or [[K[0], K[4], K[6], K[7]]] * len(poses)
    if len(lenses) != len(poses):
        raise InputError(
            f"{path}: perFrameIntrinsicCoeffs has {len(lenses)} rows, but poses has {len(poses)}; "
            "expected one for each picture: export the recording again."
        )
    for number, (pose, lens) in enumerate(zip(poses, lenses, strict=True)):
        matrix = np.eye(4)
        matrix[:3, 3] = pose[4:]
        # A quaternion far from length 1 is invalid; scipy would reject zeros and NaN.
        known = abs(np.linalg.norm(pose[:4]) - 1) < _OFF and np.isfinite(pose).all()
        matrix[:3, :3] = Rotation.from_quat(pose[:4]).as_matrix() if known else np.nan
        fx, fy, cx, cy = lens[:4]
        camera = Camera(fl_x=fx, fl_y=fy, cx=cx, cy=cy, w=read.w, h=read.h)
        yield f"{number}.jpg", matrix, camera
