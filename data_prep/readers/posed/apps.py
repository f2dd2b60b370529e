"""Reads the poses of apps that record with an iPhone: Polycam's keyframes and Record3D's metadata.

Poses are camera to world, in metres, with OpenGL axes: Polycam's in ARKit's world, whose y points
up; Record3D's relative to the first camera, so that no axis of their world points up. nerfstudio's
reader moves Record3D's principal point to the image centre; here it stays as written.

Source: the README and `polyform/core/capture_folder.py` of PolyCam/polyform; the author's answers
in the issues of marek-simonik/record3d (27, 33, 36, 83, 93), and `scripts/record3d2nerf.py` in
NVlabs/instant-ngp.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, create_model
from scipy.spatial.transform import Rotation

from data_prep.readers.posed.recording import Camera, Number, PosedPicture
from sceneprior.core.checked import checked
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json

KEYFRAMES = ("keyframes/corrected_cameras", "keyframes/cameras")
"""Folders of optimized poses, for undistorted pictures, and of ARKit's poses, for originals."""
METADATA = ("metadata", "metadata.json", "EXR_RGBD/metadata", "EXR_RGBD/metadata.json")
"""Names of the JSON in an unpacked .r3d file, and in an export of EXRs and pictures."""
_OFF = 0.01
"""Largest deviation of a quaternion's length from 1."""
_ENTRIES = [[f"t_{row}{column}" for column in range(4)] for row in range(3)]
_FIELDS: dict[str, Any] = {
    **{key: (Number, ...) for key in ("fx", "fy", "cx", "cy", "width", "height")},
    **{key: (float, ...) for row in _ENTRIES for key in row},
}
_Keyframe = create_model("_Keyframe", __config__=ConfigDict(strict=True), **_FIELDS)


def polycam_files(folder: Path) -> list[Path]:
    """The JSONs of a raw export's keyframes, preferably the optimized ones; empty without any."""
    for name in KEYFRAMES:
        if paths := sorted((folder / name).glob("*.json")):
            return paths
    return []


def read_keyframes(paths: list[Path]) -> Iterator[PosedPicture]:
    """Read Polycam's keyframes."""
    for path in paths:
        read: Any = checked(_Keyframe, read_json(path), str(path))
        rows = [[getattr(read, key) for key in row] for row in _ENTRIES]
        pictures = path.parent.name.replace("cameras", "images")
        yield PosedPicture(
            f"keyframes/{pictures}/{path.stem}.jpg",
            np.array([*rows, [0, 0, 0, 1.0]]),
            Camera(fl_x=read.fx, fl_y=read.fy, cx=read.cx, cy=read.cy, w=read.width, h=read.height),
        )


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
    for name in METADATA:
        path = folder / name
        if path.is_file() and b'"poses"' in path.read_bytes():
            return [path]
    return []


def read_metadata(path: Path) -> Iterator[PosedPicture]:
    """Read Record3D's frames."""
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
        yield PosedPicture(f"{number}.jpg", matrix, camera)
