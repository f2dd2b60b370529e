"""Sentences that describe a mistake by the user's file and keys, and how to correct it."""

import numpy as np

from data_prep.inspection.causes import C2W, MOVED, OPENCV, OPENGL, TURNED, W2C, Axes, Cause
from data_prep.inspection.evidence import Evidence
from data_prep.inspection.given import Given

_NAMES: dict[Axes, str] = {
    OPENCV: "OpenCV",
    OPENGL: "OpenGL",
    ((1, 0, 0), (0, -1, 0), (0, 0, 1)): "Unity",
    ((0, 0, 1), (1, 0, 0), (0, -1, 0)): "Unreal",
    ((0, 0, 1), (-1, 0, 0), (0, -1, 0)): "ROS",
}
_DIRECTIONS = (("right", "left"), ("down", "up"), ("forward", "backward"))
_CONTENTS = {
    C2W: "camera-to-world transforms",
    W2C: "world-to-camera transforms",
    TURNED: "rotations from world to camera beside the cameras' positions",
    MOVED: "rotations from camera to world beside translations from world to camera",
}
_TO_C2W = {
    W2C: "invert each matrix",
    TURNED: "transpose the upper left 3 x 3 of each matrix",
    MOVED: "replace the last column t of each matrix by -R t",
}
_TIMES = ("first", "second", "third")
UNITS_M = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048}


def of_cause(cause: Cause, given: Given) -> str:
    """Sentence on a mistake in the cameras, without a full stop."""
    file = given.file
    keys = " (fl_x, fl_y or camera_angle_x)" if file.endswith(".json") else ""
    if cause.family == "poses":
        return _of_poses(cause, given)
    if cause.family == "order":
        if cause.detail.startswith("sorted"):
            return (
                f"pictures and poses in {file} are sorted differently, as text (1, 10, 2) and by "
                "number (1, 2, 10): pair each pose with its picture"
            )
        if cause.detail == "reverse":
            return f"the poses in {file} are in reverse order: reverse them"
        return (
            f"each frame in {file} has the pose of {cause.detail}: pair each pose with its picture"
        )
    if cause.family == "focal":
        times = max(cause.factor, 1 / cause.factor)
        wrong = "short" if cause.factor > 1 else "long"
        return (
            f"the focal lengths in {file}{keys} are about {times:.2g} times too {wrong}: multiply "
            f"them by {cause.factor:.2g}, or give the size (w, h) of the pictures they belong to"
        )
    if cause.family == "size":
        return (
            f"the intrinsics in {file} belong to pictures of another size: give the size (w, h) "
            "that they were measured at"
        )
    keys = " (cx, cy)" if file.endswith(".json") else ""
    if cause.family == "middle":
        return (
            f"the principal point in {file}{keys} does not fit, the middle of the picture does: "
            "leave it out, or give it in pixels of a w x h picture"
        )
    across, down = cause.shift
    return (
        f"the principal point in {file}{keys} is off: about {across:+.0%} of the width and "
        f"{down:+.0%} of the height must be added; were the pictures cropped after calibration?"
    )


def _of_poses(cause: Cause, given: Given) -> str:
    reading, axes, world = given.convention
    has, wants = _axes(cause.axes, reading=""), _axes(axes, reading="")
    left = np.linalg.det(np.array(cause.axes)) < 0
    if reading == W2C:
        change = f"write {_CONTENTS[W2C]} with {_NAMES[axes]}'s axes"
    else:
        steps = [_TO_C2W[cause.reading]] if cause.reading != C2W else []
        if left:
            row = int(np.abs(world[2, :3]).argmax())
            steps.append(f"negate the {_TIMES[row]} row of each matrix")
        steps += [_columns(np.array(cause.axes) @ np.array(axes).T)] * (cause.axes != axes)
        change = ", then ".join(steps)
    if cause.reading == reading:
        system = "are of a left-handed system, with" if left else "have"
        return f"the matrices in {given.file} {system} {has} where {wants} are expected: {change}"
    said = f"{_CONTENTS[cause.reading]}"
    said += f" with {has}" * (cause.axes != axes)
    expected = _CONTENTS[reading] + f" with {wants}" * (cause.axes != axes)
    return f"the matrices in {given.file} hold {said} where {expected} are expected: {change}"


def _axes(axes: Axes, reading: str) -> str:
    words = []
    for name, row in zip("xyz", axes, strict=True):
        place = int(np.abs(row).argmax())
        words.append(f"{name} {_DIRECTIONS[place][row[place] < 0]}")
    known = f"{_NAMES[axes]}'s axes" if axes in _NAMES else "axes"
    return f"{known} ({', '.join(words)})"


def _columns(change: np.ndarray) -> str:
    """Describe the multiplication of a matrix by a signed permutation of its columns."""
    sources = np.abs(change).argmax(axis=0)
    signs = change[sources, range(3)]
    if (sources == range(3)).all():
        negated = [_TIMES[k] for k in range(3) if signs[k] < 0]
        return f"negate the {' and '.join(negated)} column of each matrix"
    new = [
        f"{'minus ' * bool(sign < 0)}the {_TIMES[k]}"
        for k, sign in zip(sources, signs, strict=True)
    ]
    return f"let the first three columns of each matrix be {', '.join(new)}"


def of_ids(evidence: Evidence, why: str, given: Given) -> str:
    """Sentence on ids that are inconsistent across frames."""
    cure = "pass --tracks auto, which finds the objects" if given.posed else "are they shuffled?"
    return (
        f"the ids of the masks are not those of objects in all frames ({counts(evidence)}; {why}): "
        f"{cure}"
    )


def counts(evidence: Evidence) -> str:
    """Text with the mean number of ids per image, and of images per id."""
    return (
        f"{evidence.masks / max(evidence.views, 1):.1f} ids per image, "
        f"{evidence.masks / max(evidence.ids, 1):.1f} images per id"
    )


def of_up(axis: int, sign: float, given: Given) -> str:
    """Sentence on cameras whose pictures' tops do not point along the room's up axis."""
    along = sign * given.convention.room_from_world[axis, :3]
    place = int(np.abs(along).argmax())
    name = "xyz"[place] if abs(along[place]) > 0.9 and along[place] > 0 else ""
    option = f"pass --up {name}" if given.posed and name in ("y", "z") else "turn the poses"
    where = f"along the {name} axis" if name else "in another direction"
    return (
        f"the tops of the pictures point {where} of {given.file}, which is not the axis that was "
        f"taken as up: {option}"
    )


def of_unit(what: str, found_m: float, bounds: tuple[float, float], factor: float | None) -> str:
    """Sentence on an implausible size; `factor` is the metres per unit that would correct it."""
    names = {value: name for name, value in UNITS_M.items()}
    cure = "are the poses in metres, and is the floor at the right height?"
    if factor is not None:
        cure = (
            f"the poses seem to be in {names[factor]}: pass --metres-per-unit {factor:g} (or write "
            "metres_per_unit)"
        )
    return (
        f"{what} {found_m:.3g} m in the median, expected {bounds[0]:g} to {bounds[1]:g} m: {cure}"
    )
