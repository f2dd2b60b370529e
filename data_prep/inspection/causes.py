"""Possible mistakes in cameras, and a room's cameras after the correction of each mistake."""

from itertools import permutations, product
from typing import NamedTuple

import numpy as np

from sceneprior.core.shards import RoomViews

Axes = tuple[tuple[int, ...], ...]
"""A camera's x, y and z axes as rows, each with its components to the right, down and forward."""
OPENCV: Axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
OPENGL: Axes = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
C2W, W2C, TURNED, MOVED = "c2w", "w2c", "turned", "moved"
"""Possible contents of a matrix: camera to world; world to camera; the camera's position with the
rotation from world to camera; the translation to the camera with the rotation from camera to
world."""
FOCAL_STEPS = tuple(k for k in range(-8, 9) if k)
"""Powers of 2^(1/6) = 1.12 by which focal lengths are scaled: 0.4 to 2.5."""
_OFF = (-0.3, -0.15, 0.0, 0.15, 0.3)
_SHIFTS = tuple((across, down) for across in _OFF for down in _OFF if across or down)
"""Shifts of the principal point, relative to the image's size."""


class Cause(NamedTuple):
    """A mistake in a room's cameras.

    Its family is one of the following; fields that a family does not use keep their defaults.
    given: no mistake. poses: the matrices hold `reading` with `axes`; the world is left-handed if
    the axes are. order: frames are in the order `detail`. focal: focal lengths must be multiplied
    by `factor`. center: the principal point must be moved by `shift`. middle: the principal point
    must be at the image centre. size: the intrinsics belong to pictures of another size. chance:
    the cameras belong to other frames.
    """

    family: str
    reading: str = ""
    axes: Axes = ()
    detail: str = ""
    factor: float = 1.0
    shift: tuple[float, float] = (0.0, 0.0)


GIVEN, CHANCE = Cause("given"), Cause("chance")


Cameras = tuple[np.ndarray, np.ndarray]
"""world_to_camera, (T, 4, 4), and intrinsics, (T, 3, 3), both float64."""


class Convention(NamedTuple):
    """Convention of the matrices that a room's cameras were read from."""

    reading: str = W2C
    axes: Axes = OPENCV
    room_from_world: np.ndarray = np.eye(4)
    """(4, 4) rigid, from the world of the matrices (in metres) to the room."""


def corrected(views: RoomViews, convention: Convention) -> dict[Cause, Cameras]:
    """Cameras after the correction of each cause; those of `GIVEN` are unchanged.

    The causes depend only on the convention, so that sums over rooms are possible. Likelier causes
    come first.
    """
    poses, lenses = views.world_to_camera.astype(np.float64), views.intrinsics.astype(np.float64)
    found = {GIVEN: (poses, lenses)}
    for cause, other in _poses(poses, convention).items():
        found[cause] = other, lenses
    for name, order in _orders(len(poses)).items():
        found[Cause("order", detail=name)] = poses[order], lenses
    for cause, lens in _lenses(lenses, views.image_size).items():
        found[cause] = poses, lens
    found[CHANCE] = poses[_dealt_out(len(poses))], lenses
    return found


def _poses(poses: np.ndarray, convention: Convention) -> dict[Cause, np.ndarray]:
    """World-to-camera matrices under each hypothesis on what the written matrices hold."""
    of_world = np.linalg.inv(convention.room_from_world) @ np.linalg.inv(poses)
    written = of_world @ np.linalg.inv(_square(convention.axes))
    if convention.reading == W2C:
        written = np.linalg.inv(written)
    rotation, translation = written[:, :3, :3], written[:, :3, 3:]
    contents = {
        C2W: written,
        W2C: np.linalg.inv(written),
        TURNED: _matrix(rotation.swapaxes(1, 2), translation),
        MOVED: _matrix(rotation, -rotation @ translation),
    }
    usual = [(reading, axes) for reading in contents for axes in (OPENGL, OPENCV)]
    rare = [(convention.reading, axes) for axes in _all_axes() if axes not in (OPENGL, OPENCV)]
    found = {}
    for reading, axes in usual + rare:
        if (reading, axes) != (convention.reading, convention.axes):
            camera_to_world = contents[reading] @ _square(axes)
            # A mirrored world can be rotated until the room's z is the mirrored axis.
            mirror = np.diag([1.0, 1, np.linalg.det(_square(axes)), 1])
            in_room = mirror @ convention.room_from_world @ camera_to_world
            found[Cause("poses", reading, axes)] = np.linalg.inv(in_room)
    return found


def _all_axes() -> list[Axes]:
    """The 48 assignments of a camera's axes, left-handed ones last."""
    signed = [
        tuple(
            tuple(sign * (k == place) for k in range(3))
            for place, sign in zip(order, signs, strict=True)
        )
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
    ]
    return sorted(signed, key=lambda axes: -round(np.linalg.det(np.array(axes))))


def _square(axes: Axes) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3] = axes
    return matrix


def _matrix(rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    matrix = np.tile(np.eye(4), (len(rotation), 1, 1))
    matrix[:, :3, :3], matrix[:, :3, 3:] = rotation, translation
    return matrix


def _orders(frames: int) -> dict[str, np.ndarray]:
    """For each way in which poses may be out of order, the index of each frame's own pose."""
    numbers = np.arange(frames)
    as_text = np.array(sorted(range(frames), key=lambda k: str(k + 1)), dtype=np.int64)
    return {
        "the frame before": np.roll(numbers, -1),
        "the next frame": np.roll(numbers, 1),
        "the frame two before": np.roll(numbers, -2),
        "the frame two later": np.roll(numbers, 2),
        "reverse": numbers[::-1],
        "sorted as text": np.argsort(as_text),
        "sorted as numbers": as_text,
    }


def _lenses(lenses: np.ndarray, image_size: tuple[int, int]) -> dict[Cause, np.ndarray]:
    height, width = image_size
    size = np.array([width, height], dtype=np.float64)
    found = {}
    for step in FOCAL_STEPS:
        factor = 2 ** (step / 6)
        other = lenses.copy()
        other[:, [0, 1], [0, 1]] *= factor
        found[Cause("focal", factor=factor)] = other
    middle = lenses.copy()
    middle[:, :2, 2] = size / 2
    found[Cause("middle")] = middle
    resized = lenses.copy()
    center = lenses[:, :2, 2]
    resized[:, :2] *= (size / 2 / np.where(center > 0, center, size / 2))[..., None]
    found[Cause("size")] = resized
    for shift in _SHIFTS:
        other = lenses.copy()
        other[:, :2, 2] += size * np.array(shift)
        found[Cause("center", shift=shift)] = other
    return found


def _dealt_out(frames: int) -> np.ndarray:
    """A random order in which no frame keeps its place."""
    order = np.random.default_rng(0).permutation(frames)
    dealt = np.empty_like(order)
    dealt[order] = np.roll(order, 1)
    return dealt
