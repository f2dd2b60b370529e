"""Turns the cameras of a posed room upright: finds the up direction, and axes that are wrong."""

from collections.abc import Sequence

import numpy as np

from data_prep.readers.frames import GL_TO_CV
from data_prep.readers.posed.recording import Recording
from sceneprior.core.errors import InputError

UP = ("auto", "z", "y", "cameras")
_Y_UP = {
    "y": np.eye(4),
    # (x, y, z) with z up -> (x, z, -y); stays right-handed.
    "z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
}
_LARGEST_SPREAD_M = 100.0
_LEAST_TURN = 0.1
"""Minimum ratio of the second to the first singular value of the cameras' sideways axes; if all
cameras look the same way, their tilt cannot be determined."""


def upright_cameras(
    recording: Recording, frames: Sequence[int], up: str, metres_per_unit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rotate cameras to a world whose y points up, in metres.

    `up` is one of `UP`; `auto` is the recording's own.

    Returns:
        Camera-to-world matrices, (views, 4, 4) with OpenCV axes, and the (4, 4) transform from the
        file's world (in metres) to this one.
    """
    poses = np.stack([recording.frames[i].camera_to_world for i in frames])
    poses[:, :3, 3] *= recording.metres_per_unit or metres_per_unit
    if up == "auto":
        up = recording.up
    turn = _turn_of_cameras(recording, poses) if up == "cameras" else _Y_UP[up]
    upright = turn @ poses
    spread = np.ptp(upright[:, :3, 3], axis=0).max()
    if spread > _LARGEST_SPREAD_M:
        unit = "0.01, if they are in centimetres" if spread < 3000 else "0.001, in millimetres"
        raise InputError(
            f"{recording.path}: its cameras are spread over {spread:.0f} m; is metres_per_unit "
            f"wrong? Pass --metres-per-unit {unit}."
        )
    return upright @ GL_TO_CV, turn


def _turn_of_cameras(recording: Recording, poses: np.ndarray) -> np.ndarray:
    """Rotation (4, 4) that makes y the up direction of cameras that were held upright.

    The sideways axes of such cameras are horizontal, whatever their pitch, so up is the direction
    perpendicular to all of them.
    """
    _, strength, axes = np.linalg.svd(poses[:, :3, 0])
    if len(strength) < 2 or strength[1] < _LEAST_TURN * strength[0]:
        raise InputError(
            f"{recording.path}: its cameras all look in about the same direction, so the up "
            "direction is unknown; turn the poses until an axis points up, and name it with --up."
        )
    y = axes[2] * np.sign(axes[2] @ poses[:, :3, 1].sum(axis=0))
    x = np.eye(3)[np.argmin(np.abs(y))]
    x = x - (x @ y) * y
    x /= np.linalg.norm(x)
    turn = np.eye(4)
    turn[:3, :3] = x, y, np.cross(x, y)
    return turn


def floor_center(recording: Recording, turn: np.ndarray) -> np.ndarray | None:
    """x, z of the floor's centre in the world of `upright_cameras`; None if the file has none."""
    if recording.floor_center_m is None:
        return None
    level = [axis for axis in range(3) if abs(turn[1, axis]) < 0.5]
    if len(level) != 2 or not np.isin(np.abs(turn[1]), (0.0, 1.0)).all():
        raise InputError(
            f"{recording.path}: floor_center_m is along two level axes, but none of this world's "
            "is level; leave it out, or turn the poses and name the axis with --up."
        )
    center = np.zeros(4)
    center[level] = recording.floor_center_m
    return (turn @ center)[[0, 2]]


def why_below_floor(recording: Recording, turn: np.ndarray) -> str:
    """Likely reason why cameras are below the floor, as the end of a sentence."""
    written = recording.good_poses()
    axis = int(np.abs(turn[1, :3]).argmax())
    # The sideways axis of an upright camera is level: it has no part along the axis up.
    level, level_if_inverted = np.abs(written[:, axis, 0]), np.abs(written[:, 0, axis])
    if level_if_inverted.mean() < 0.5 * level.mean():
        return "the matrices seem to be world-to-camera: invert each."
    other = seems_up(recording)
    if level.mean() > 0.2 and other is not None and "xyz"[axis] != other:
        return f"the tops of the pictures point along {other}: pass --up {other}."
    return (
        "are the last columns of the matrices translations from world to camera, not positions "
        "(-R t)? Else check floor_m, metres_per_unit and --up."
    )


def seems_up(recording: Recording) -> str | None:
    """Axis along which the cameras' up vectors point, `y` or `z`; None if neither is clear."""
    tops = recording.good_poses()[:, :3, 1]
    if not len(tops):
        return None
    mean = tops.mean(axis=0)
    best = "y" if mean[1] > mean[2] else "z"
    return best if max(mean[1], mean[2]) > 0.7 else None
