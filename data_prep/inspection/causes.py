"""The table of mistakes in cameras: how each is corrected, and the sentence that names it.

A correction is tried on a room; the mistake is there if masks and cameras agree better afterwards,
with each other (evidence.py) or with the 3D ground truth, if it is known (agreement.py).
"""

from collections.abc import Callable, Iterable
from itertools import permutations, product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from data_prep.inspection.agreement import Room, compare, score
from sceneprior.core.cameras import camera_centers, pixel_rays, rigid
from sceneprior.core.checked import number_array

FOCAL_STEPS = tuple(k for k in range(-8, 9) if k)
"""Powers of 2^(1/6) = 1.12 by which focal lengths are scaled: 0.4 to 2.5."""
_OFF = (-0.3, -0.15, 0.0, 0.15, 0.3)
"""Shifts of the principal point along each side, relative to the image's size."""

Axes = tuple[tuple[int, ...], ...]
"""A camera's x, y and z axes as rows, each with its components to the right, down and forward."""
OPENCV: Axes = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
OPENGL: Axes = ((1, 0, 0), (0, -1, 0), (0, 0, -1))
_NAMES: dict[Axes, str] = {
    OPENCV: "OpenCV",
    OPENGL: "OpenGL",
    ((1, 0, 0), (0, -1, 0), (0, 0, 1)): "Unity",
    ((0, 0, 1), (1, 0, 0), (0, -1, 0)): "Unreal",
    ((0, 0, 1), (-1, 0, 0), (0, -1, 0)): "ROS",
}
_EVERY_AXES: list[Axes] = sorted(
    (
        tuple(map(tuple, (np.eye(3, dtype=int)[list(order)] * np.array(signs)[:, None]).tolist()))
        for order in permutations(range(3))
        for signs in product((1, -1), repeat=3)
    ),
    key=lambda axes: -round(np.linalg.det(np.array(axes))),
)
"""The 48 assignments of a camera's axes, left-handed ones last."""
_DIRECTIONS = (("right", "left"), ("down", "up"), ("forward", "backward"))
_TIMES = ("first", "second", "third")

C2W, W2C, TURNED, MOVED = "c2w", "w2c", "turned", "moved"
"""Possible contents of a matrix: camera to world; world to camera; the camera's position with the
rotation from world to camera; the translation to the camera with the rotation from camera to
world."""
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


class Convention(NamedTuple):
    """Convention of the matrices that a room's cameras were read from, and the file's name."""

    file: str = "the shards (`world_to_camera`)"
    """Name for messages: transforms.json."""
    reading: str = W2C
    axes: Axes = OPENCV
    room_from_world: np.ndarray = np.eye(4)
    """(4, 4) rigid, from the world of the matrices (in metres) to the room."""
    posed: bool = False
    """True for rooms of prep-posed, whose options the messages may name."""

    @classmethod
    def stated(
        cls, source: object, file: str | None = None, room_from_world: Any = None
    ) -> "Convention":
        """Convention of a data set, and of the file of poses that the report states for a room
        (`PreparedRoom.cameras`)."""
        usual = _OF_SOURCE.get(source, cls())
        if file is None:
            return usual
        world = number_array(room_from_world).reshape(4, 4)
        if Path(file).name in ("cameras.bin", "cameras.txt"):
            name = f"COLMAP's {Path(file).parent.as_posix()}"
            return usual._replace(file=name, reading=W2C, axes=OPENCV, room_from_world=world)
        return usual._replace(file=Path(file).name, room_from_world=world)

    def with_keys(self, keys: str) -> str:
        """Name of the file, with its keys if it is a JSON."""
        return f"{self.file} ({keys})" if self.file.endswith(".json") else self.file


_OF_SOURCE: dict[object, Convention] = {
    "posed": Convention("the file of poses", C2W, OPENGL, posed=True),
    "scannet": Convention("the scans' .sens files", C2W, OPENCV),
}


class Cause(NamedTuple):
    """A mistake: a key of `SENTENCES`, and which one of the mistakes of this name it is."""

    name: str
    detail: Any = None


GIVEN, CHANCE = Cause("given"), Cause("chance")
"""No mistake; and cameras of other frames, dealt out at random."""

Corrected = Iterable[tuple[Cause, Room]]
"""Causes, each with the room after its correction."""


def corrections(room: Room, convention: Convention) -> dict[Cause, Room]:
    """The room after the correction of each cause, likelier causes first; `GIVEN` corrects nothing.

    The unit needs 3D objects. The other causes depend only on the convention, so that sums over
    rooms are possible.
    """
    views = room.views
    exact = room.seen_by(views.world_to_camera.astype(float), views.intrinsics.astype(float))
    tried = (correct(exact, convention) for correct in (_poses, _orders, _lenses, _scaled))
    return {GIVEN: exact} | {cause: other for row in tried for cause, other in row}


def sentence_of(cause: Cause, convention: Convention) -> str:
    """Sentence on a mistake, without a full stop."""
    return SENTENCES[cause.name](cause.detail, convention)


def _poses(room: Room, convention: Convention) -> Corrected:
    """World-to-camera matrices under each hypothesis on what the written matrices hold."""
    world = convention.room_from_world
    of_world = np.linalg.inv(world) @ np.linalg.inv(room.views.world_to_camera)
    written = of_world @ np.linalg.inv(rigid(convention.axes))
    if convention.reading == W2C:
        written = np.linalg.inv(written)
    turned, moved = written.copy(), written.copy()
    turned[:, :3, :3] = written[:, :3, :3].swapaxes(1, 2)
    moved[:, :3, 3:] = -written[:, :3, :3] @ written[:, :3, 3:]
    contents = {C2W: written, W2C: np.linalg.inv(written), TURNED: turned, MOVED: moved}
    usual = [(reading, axes) for reading in contents for axes in (OPENGL, OPENCV)]
    rare = [(convention.reading, axes) for axes in _EVERY_AXES if axes not in (OPENGL, OPENCV)]
    for reading, axes in usual + rare:
        if (reading, axes) != (convention.reading, convention.axes):
            camera_to_world = contents[reading] @ rigid(axes)
            # A mirrored world can be rotated until the room's z is the mirrored axis.
            mirror = np.diag([1.0, 1, np.linalg.det(rigid(axes)), 1])
            in_room = np.linalg.inv(mirror @ world @ camera_to_world)
            yield Cause("poses", (reading, axes)), room.seen_by(in_room)


def _wrong_poses(held: tuple[str, Axes], convention: Convention) -> str:
    """The matrices hold another reading or other axes, `held`, than the convention's."""
    (reading, axes), expected, expected_axes = held, convention.reading, convention.axes
    has, wants = _in_words(axes), _in_words(expected_axes)
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
        said = f"{system} {has} where {wants}"
    else:
        has, wants = (f" with {text}" * (axes != expected_axes) for text in (has, wants))
        said = f"hold {_CONTENTS[reading]}{has} where {_CONTENTS[expected]}{wants}"
    return f"the matrices in {convention.file} {said} are expected: {change}"


def _in_words(axes: Axes) -> str:
    words = []
    for name, row in zip("xyz", axes, strict=True):
        place = int(np.abs(row).argmax())
        words.append(f"{name} {_DIRECTIONS[place][row[place] < 0]}")
    known = f"{_NAMES[axes]}'s axes" if axes in _NAMES else "axes"
    return f"{known} ({', '.join(words)})"


def _columns(change: np.ndarray) -> str:
    """Describe the multiplication of a matrix by a signed permutation of its columns."""
    sources = np.abs(change).argmax(axis=0)
    negative = change[sources, range(3)] < 0
    if (sources == range(3)).all():
        negated = [_TIMES[k] for k in np.flatnonzero(negative)]
        return f"negate the {' and '.join(negated)} column of each matrix"
    new = [
        f"{'minus ' * bool(negative[k])}the {_TIMES[source]}" for k, source in enumerate(sources)
    ]
    return f"let the first three columns of each matrix be {', '.join(new)}"


def _orders(room: Room, _: Convention) -> Corrected:
    """Each frame with its own pose, for each way in which poses may be out of order; last, dealt
    out at random, so that no frame keeps its own."""
    numbers = np.arange(len(room.views.visible))
    as_text = np.array(sorted(numbers, key=lambda k: str(k + 1)), dtype=np.int64)
    orders = {
        "the frame before": np.roll(numbers, -1),
        "the next frame": np.roll(numbers, 1),
        "the frame two before": np.roll(numbers, -2),
        "the frame two later": np.roll(numbers, 2),
        "reverse": numbers[::-1],
        "sorted as text": np.argsort(as_text),
        "sorted as numbers": as_text,
    }
    for name, order in orders.items():
        yield Cause("order", name), room.seen_by(room.views.world_to_camera[order])
    order = np.random.default_rng(0).permutation(numbers)
    yield CHANCE, room.seen_by(room.views.world_to_camera[np.roll(order, 1)[np.argsort(order)]])


def _wrong_order(found: str, convention: Convention) -> str:
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


def _lenses(room: Room, _: Convention) -> Corrected:
    """Intrinsics with other focal lengths or principal points, or of pictures of another size."""
    given, middle = room.views.intrinsics, room.size_px / 2
    center = given[:, :2, 2]

    def other(focal: np.ndarray | float, center: np.ndarray) -> Room:
        lenses = given.copy()
        lenses[:, [0, 1], [0, 1]] *= focal
        lenses[:, :2, 2] = center
        return room.seen_by(lenses=lenses)

    for step in FOCAL_STEPS:
        yield Cause("focal", 2 ** (step / 6)), other(2 ** (step / 6), center)
    yield Cause("middle"), other(1, middle)
    larger = middle / np.where(center > 0, center, middle)
    yield Cause("size"), other(larger, center * larger)
    for shift in product(_OFF, _OFF):
        if any(shift):
            yield Cause("center", shift), other(1, center + room.size_px * np.array(shift))


def _wrong_focal(factor: float, convention: Convention) -> str:
    """The focal lengths must be multiplied by `factor`."""
    times, wrong = max(factor, 1 / factor), "short" if factor > 1 else "long"
    return (
        f"the focal lengths in {convention.with_keys('fl_x, fl_y or camera_angle_x')} are about "
        f"{times:.2g} times too {wrong}: multiply them by {factor:.2g}, or give the size (w, h) of "
        "the pictures they belong to"
    )


def _scaled(room: Room, _: Convention) -> Corrected:
    """Translations of another unit, estimated from rays through 2D boxes, which must meet their
    objects."""
    views, there = room.views, [k for k, body in enumerate(room.bodies) if body is not None]
    shown = views.visible[:, there]
    if not shown.any():
        return
    hulls = [body.hull.points_m for body in room.bodies if body is not None]
    targets = np.array([(points.min(axis=0) + points.max(axis=0)) / 2 for points in hulls])
    pixels = (views.boxes[:, there, :2] + views.boxes[:, there, 2:]) / 2 * room.size_px
    rays = pixel_rays(pixels, views.world_to_camera, views.intrinsics)[shown]
    view, item = np.nonzero(shown)
    eyes, targets = camera_centers(views.world_to_camera)[view], targets[item]
    across, length = np.cross(rays, eyes), (np.cross(rays, eyes) ** 2).sum(axis=1)
    ratios = (across * np.cross(rays, targets)).sum(axis=1)[length > 0] / length[length > 0]
    factor = float(np.median(ratios)) if len(ratios) else 0.0
    if factor <= 0:
        return

    def scaled(factor: float) -> Room:
        return room.seen_by(views.world_to_camera * [[1, 1, 1, factor]])

    # Centres of 2D boxes are not exactly those of the objects, so the factor is refined.
    for step in (1.12, 1.04, 1.015):
        tried = [factor * step**k for k in (0, -1, 1, -2, 2)]
        factor = max(tried, key=lambda factor: score(compare(scaled(factor)).agreement))
    yield Cause("unit", factor), scaled(factor)


SENTENCES: dict[str, Callable[[Any, Convention], str]] = {
    "poses": _wrong_poses,
    "order": _wrong_order,
    "focal": _wrong_focal,
    "middle": lambda _, convention: (
        f"the principal point in {convention.with_keys('cx, cy')} does not fit, the middle of the "
        "picture does: leave it out, or give it in pixels of a w x h picture"
    ),
    "size": lambda _, convention: (
        f"the intrinsics in {convention.file} belong to pictures of another size: give the size "
        "(w, h) that they were measured at"
    ),
    "center": lambda shift, convention: (
        f"the principal point in {convention.with_keys('cx, cy')} is off: about {shift[0]:+.0%} of "
        f"the width and {shift[1]:+.0%} of the height must be added; were the pictures cropped "
        "after calibration?"
    ),
    "scale": lambda scale, convention: (
        f"{scale}: pass --metres-per-unit {1 / scale.factor:.2g}, or multiply the one given by this"
        if convention.posed
        else f"{scale}: are the translations of the cameras in metres?"
    ),
    "unit": lambda factor, convention: (
        "the translations of the cameras seem to have another unit than the objects"
    ),
}
"""Sentences on mistakes by their names, given the detail of the cause; without full stops."""
