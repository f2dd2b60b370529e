"""Sentences that name a mistake by the user's file and keys, and say how to correct it."""

from typing import Any

import numpy as np

from data_prep.inspection.camera_convention import (
    C2W,
    MOVED,
    OPENCV,
    OPENGL,
    TURNED,
    W2C,
    Axes,
    Convention,
)

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


def wrong_matrices(held: tuple[str, Axes], convention: Convention) -> str:
    """The matrices hold another reading or other axes, `held`, than the convention's."""
    (reading, axes), expected, expected_axes = held, convention.reading, convention.axes
    has, wants = _axes(axes), _axes(expected_axes)
    left = np.linalg.det(np.array(axes)) < 0
    if expected == W2C:
        change = f"write {_CONTENTS[W2C]} with {_NAMES[expected_axes]}'s axes"
    else:
        steps = [_TO_C2W[reading]] if reading != C2W else []
        if left:
            row = int(np.abs(convention.room_from_world[2, :3]).argmax())
            steps.append(f"negate the {_TIMES[row]} row of each matrix")
        steps += [_columns(np.array(axes) @ np.array(expected_axes).T)] * (axes != expected_axes)
        change = ", then ".join(steps)
    if reading == expected:
        system = "are of a left-handed system, with" if left else "have"
        said = f"{system} {has} where {wants} are expected"
    else:
        said = f"hold {_CONTENTS[reading]}" + f" with {has}" * (axes != expected_axes)
        said += f" where {_CONTENTS[expected]}" + f" with {wants}" * (axes != expected_axes)
        said += " are expected"
    return f"the matrices in {convention.file} {said}: {change}"


def _axes(axes: Axes) -> str:
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


def wrong_order(found: str, convention: Convention) -> str:
    """Frames have the poses of other frames."""
    file = convention.file
    if found.startswith("sorted"):
        return (
            f"pictures and poses in {file} are sorted differently, as text (1, 10, 2) and by "
            "number (1, 2, 10): pair each pose with its picture"
        )
    if found == "reverse":
        return f"the poses in {file} are in reverse order: reverse them"
    return f"each frame in {file} has the pose of {found}: pair each pose with its picture"


def wrong_focal(factor: float, convention: Convention) -> str:
    """The focal lengths must be multiplied by `factor`."""
    times, wrong = max(factor, 1 / factor), "short" if factor > 1 else "long"
    return (
        f"the focal lengths in {_keys(convention, 'fl_x, fl_y or camera_angle_x')} are about "
        f"{times:.2g} times too {wrong}: multiply them by {factor:.2g}, or give the size (w, h) of "
        "the pictures they belong to"
    )


def wrong_size(_: Any, convention: Convention) -> str:
    """The intrinsics belong to pictures of another size."""
    return (
        f"the intrinsics in {convention.file} belong to pictures of another size: give the size "
        "(w, h) that they were measured at"
    )


def wrong_center(shift: tuple[float, float] | None, convention: Convention) -> str:
    """The principal point must be moved by `shift`, relative to the picture; None: to its
    middle."""
    where = f"the principal point in {_keys(convention, 'cx, cy')}"
    if shift is None:
        return (
            f"{where} does not fit, the middle of the picture does: leave it out, or give it in "
            "pixels of a w x h picture"
        )
    return (
        f"{where} is off: about {shift[0]:+.0%} of the width and {shift[1]:+.0%} of the height "
        "must be added; were the pictures cropped after calibration?"
    )


def _keys(convention: Convention, keys: str) -> str:
    return f"{convention.file} ({keys})" if convention.file.endswith(".json") else convention.file


def wrong_ids(counts: str, why: str, convention: Convention) -> str:
    """The ids of the masks are not consistent across frames."""
    cure = "are they shuffled?"
    if convention.posed:
        cure = "pass --tracks auto, which finds the objects"
    return f"the ids of the masks are not those of objects in all frames ({counts}; {why}): {cure}"


def wrong_up(axis: int, sign: float, convention: Convention) -> str:
    """The tops of the pictures do not point along the room's up axis, but along another."""
    along = sign * convention.room_from_world[axis, :3]
    place = int(np.abs(along).argmax())
    name = "xyz"[place] if abs(along[place]) > 0.9 and along[place] > 0 else ""
    option = f"pass --up {name}" if convention.posed and name in ("y", "z") else "turn the poses"
    where = f"along the {name} axis" if name else "in another direction"
    return (
        f"the tops of the pictures point {where} of {convention.file}, which is not the axis that "
        f"was taken as up: {option}"
    )


def wrong_unit(
    what: str, found_m: float, bounds: tuple[float, float], metres_per_unit: float | None
) -> str:
    """A size is implausible: "the cameras stand {} above the floor"; with the metres per unit of
    the poses that would correct it, if there are any."""
    cure = "are the poses in metres, and is the floor at the right height?"
    if metres_per_unit is not None:
        names = {value: name for name, value in UNITS_M.items()}
        cure = (
            f"the poses seem to be in {names[metres_per_unit]}: pass --metres-per-unit "
            f"{metres_per_unit:g} (or write metres_per_unit)"
        )
    size = what.format(f"{found_m:.3g} m")
    return f"{size} in the median, expected {bounds[0]:g} to {bounds[1]:g} m: {cure}"
