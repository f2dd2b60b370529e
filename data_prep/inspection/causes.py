"""The table of mistakes in cameras and ids: how each is corrected, and the sentence that names it.

A correction is tried on a room; the mistake is there if masks and cameras agree better afterwards,
with each other (evidence.py) or with the 3D ground truth, if it is known (agreement.py).
"""

from collections.abc import Callable, Iterable
from itertools import permutations, product
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from data_prep.inspection import messages
from data_prep.inspection.agreement import Room, compare, compare_boxes, projections, score
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

FOCAL_STEPS = tuple(k for k in range(-8, 9) if k)
"""Powers of 2^(1/6) = 1.12 by which focal lengths are scaled: 0.4 to 2.5."""
_OFF = (-0.3, -0.15, 0.0, 0.15, 0.3)
"""Shifts of the principal point along each side, relative to the image's size."""


class Cause(NamedTuple):
    """A mistake: the name of its row of `TABLE`, and which one of the row's mistakes it is."""

    name: str
    detail: Any = None


GIVEN, CHANCE = Cause("given"), Cause("chance")
"""No mistake; and cameras of other frames, dealt out at random."""

Corrected = Iterable[tuple[Cause, Room]]


class Row(NamedTuple):
    """A row of the table."""

    correct: Callable[[Room, Convention], Corrected]
    """The room after the correction of each mistake of the row."""
    say: Callable[[Any, Convention], str]
    """Sentence on a mistake, given its detail; without a full stop."""
    corrected: str = "corrected"
    """Name of the correction, with {} for the detail."""
    with_truth: bool = True
    """True if the correction is also scored with the 3D ground truth."""


def corrections(room: Room, convention: Convention) -> dict[Cause, Room]:
    """The room after the correction of each cause, likelier causes first; `GIVEN` corrects nothing.

    Rows that need 3D objects are left out for a room without. The other causes depend only on the
    convention, so that sums over rooms are possible.
    """
    views = room.views
    exact = room.seen_by(views.world_to_camera.astype(float), views.intrinsics.astype(float))
    return {
        cause: other for row in TABLE.values() for cause, other in row.correct(exact, convention)
    }


def sentence_of(cause: Cause, convention: Convention) -> str:
    """Sentence on a mistake, without a full stop."""
    return TABLE[cause.name].say(cause.detail, convention)


def _poses(room: Room, convention: Convention) -> Corrected:
    """World-to-camera matrices under each hypothesis on what the written matrices hold."""
    world = convention.room_from_world
    of_world = np.linalg.inv(world) @ np.linalg.inv(room.views.world_to_camera)
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
    for reading, axes in usual + rare:
        if (reading, axes) != (convention.reading, convention.axes):
            camera_to_world = contents[reading] @ _square(axes)
            # A mirrored world can be rotated until the room's z is the mirrored axis.
            mirror = np.diag([1.0, 1, np.linalg.det(_square(axes)), 1])
            in_room = np.linalg.inv(mirror @ world @ camera_to_world)
            yield Cause("poses", (reading, axes)), room.seen_by(in_room)


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


def _orders(room: Room, _: Convention) -> Corrected:
    """Each frame with its own pose, for each way in which poses may be out of order."""
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


def _focal(room: Room, _: Convention) -> Corrected:
    for step in FOCAL_STEPS:
        lenses = room.views.intrinsics.copy()
        lenses[:, [0, 1], [0, 1]] *= (factor := 2 ** (step / 6))
        yield Cause("focal", factor), room.seen_by(lenses=lenses)


def _middle(room: Room, _: Convention) -> Corrected:
    lenses = room.views.intrinsics.copy()
    lenses[:, :2, 2] = room.size_px / 2
    yield Cause("middle"), room.seen_by(lenses=lenses)


def _size(room: Room, _: Convention) -> Corrected:
    lenses, middle = room.views.intrinsics.copy(), room.size_px / 2
    center = lenses[:, :2, 2]
    lenses[:, :2] *= (middle / np.where(center > 0, center, middle))[..., None]
    yield Cause("size"), room.seen_by(lenses=lenses)


def _centers(room: Room, _: Convention) -> Corrected:
    for shift in product(_OFF, _OFF):
        if any(shift):
            lenses = room.views.intrinsics.copy()
            lenses[:, :2, 2] += room.size_px * np.array(shift)
            yield Cause("center", shift), room.seen_by(lenses=lenses)


def _dealt_out(room: Room, _: Convention) -> Corrected:
    """Cameras in a random order in which no frame keeps its own."""
    order = np.random.default_rng(0).permutation(len(room.views.visible))
    dealt = np.empty_like(order)
    dealt[order] = np.roll(order, 1)
    yield CHANCE, room.seen_by(room.views.world_to_camera[dealt])


def _scaled(room: Room, _: Convention) -> Corrected:
    """Translations of another unit, estimated from rays through 2D boxes, which must meet their
    objects."""
    pairs = np.argwhere(compare(room).judged) if room.bodies else np.zeros((0, 2), dtype=int)
    if not len(pairs):
        return
    rows, items = pairs.T
    views = room.views
    centers = np.array(
        [np.zeros(3) if body is None else body.hull.middle_m for body in room.bodies]
    )[items]
    boxes = views.boxes[rows, items]
    pixels = (boxes[:, :2] + boxes[:, 2:]) / 2 * room.size_px
    pixels = np.concatenate([pixels, np.ones((len(rows), 1))], axis=1)
    rays = np.linalg.solve(views.intrinsics[rows], pixels[..., None])[..., 0]
    poses = views.world_to_camera[rows]
    across = np.cross(rays, poses[:, :3, 3])
    off = np.cross(rays, (poses[:, :3, :3] @ centers[..., None])[..., 0])
    length = (across**2).sum(axis=1)
    ratios = -(across * off).sum(axis=1) / np.where(length > 0, length, np.nan)
    ratios = ratios[np.isfinite(ratios)]
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


def _other_ids(room: Room, _: Convention) -> Corrected:
    """Masks matched to the objects that they fit best.

    Masks that fit no object are left out, because ids may have been shifted onto walls; if fewer
    than a quarter of all masks remain, ids explain nothing.
    """
    if not room.bodies:
        return
    boxes, visible = projections(room), room.views.visible
    pairs = [
        compare_boxes(room, np.broadcast_to(boxes[:, k : k + 1], boxes.shape))
        for k in range(len(room.bodies))
    ]
    seen = visible.sum(axis=0)
    held = np.stack([(pair.held & visible).sum(axis=0) for pair in pairs], axis=1)
    iou = np.stack([(pair.iou * visible).sum(axis=0) for pair in pairs], axis=1)
    rows, others = linear_sum_assignment(held + iou, maximize=True)
    fits = held[rows, others] > seen / 2
    if seen[fits].sum() >= seen.sum() / 4:
        yield (
            Cause("ids"),
            room._replace(
                bodies=[
                    room.bodies[other] if fit else None
                    for other, fit in zip(others, fits, strict=True)
                ]
            ),
        )


def _plainly(sentence: str) -> Callable[[Any, Convention], str]:
    return lambda detail, convention: sentence


TABLE: dict[str, Row] = {
    "given": Row(lambda room, _: [(GIVEN, room)], _plainly(""), with_truth=False),
    "poses": Row(_poses, messages.wrong_matrices),
    "order": Row(_orders, messages.wrong_order),
    "focal": Row(_focal, messages.wrong_focal),
    "middle": Row(_middle, messages.wrong_center),
    "size": Row(_size, messages.wrong_size),
    "center": Row(_centers, messages.wrong_center, with_truth=False),
    "chance": Row(_dealt_out, _plainly(""), with_truth=False),
    "unit": Row(
        _scaled,
        _plainly("the translations of the cameras seem to have another unit than the objects"),
        "times {:.2g}",
    ),
    "ids": Row(
        _other_ids,
        _plainly("the instance ids of the masks seem to be those of other objects"),
        "with ids exchanged",
    ),
}
"""Rows by name; the last two need 3D objects."""
