"""Corrects the poses of a room that its masks contradict, and finds the masks that are wrong.

The planes through the centres of two cameras (epipolar planes) form a pencil. Those that intersect
an object are a range of this pencil, and the two planes at the ends of the range are tangent to the
object. The range is the same in both images, whatever the object's shape; so where the outlines are
the object's own, not cut off by another object or the image border, a difference between the two
ranges is an error of a pose or of a mask (Wong and Cipolla, "Structure and motion from
silhouettes", ICCV 2001).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import ndimage
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from sceneprior.core.cameras import camera_at, camera_centers
from sceneprior.core.classes import VOID
from sceneprior.core.observations import TOUCH_PX, Observations, observe

PAIRS_AT_MOST = 20_000
"""Maximum number of pairs of masks; if there are more, they are thinned evenly."""
_BASELINE_M = 0.1
"""Smallest distance between two cameras."""
_WIDEST_RAD = 1.5
"""Largest angle between the plane through a mask's middle and any other through the mask; it is
larger if one camera stands in front of the object in the other's image."""
WRONG_PX, LESS = 0.3, 0.9
"""Poses are corrected if the median gap exceeds `WRONG_PX`, and if a correction that is fitted to
one half of the objects makes that of the other half smaller than the share `LESS` of what it was.
Exact poses have at most 0.24 px with exact masks, and at least 0.99 of it with ragged ones."""
_LEAST_GAPS = 30
"""Fewer gaps tell nothing."""
TURN_RAD, MOVE_M = np.radians(1.0), 0.02
"""Assumed standard deviations of the errors of a pose; they keep poses that the masks do not
determine where they are."""
_SCALE_PX = 1.0
"""Gap from which a measurement loses its weight; where the median is larger, the median."""
_ROUNDS = 10
_TOO_WIDE, _TOO_WIDE_PX = 0.1, 3.0
"""A mask is too wide for another one if it exceeds that one's range of planes by this share, and by
this many pixels."""
_FIT_PX = 1.5
"""Median gap up to which poses fit the masks. If no correction comes so far, something else is
wrong, which `inspect --verify` may name; and it cannot be told which masks are wrong."""
_MOST_AGAINST, _LEAST_PAIRS = 0.6, 4
"""A mask is wrong if it is too wide for more than this share of the object's other masks, of which
at least so many can be compared."""
_DIGITS = 6
"""Decimals of a correction, in radians and metres, so that last bits of sums do not matter."""


class Outlines(NamedTuple):
    """Convex hulls of the masks of one room, and the pairs of masks that show the same object."""

    rays: Float[np.ndarray, "masks corners 3"]
    """Unit vectors through the corners, in the camera's axes; the last one is repeated."""
    clear: Bool[np.ndarray, "masks corners"]
    """True where neither another object nor the image's border touches the corner."""
    view: Int[np.ndarray, " masks"]
    item: Int[np.ndarray, " masks"]
    """Index of the object."""
    focal_px: Float[np.ndarray, " masks"]
    pairs: Int[np.ndarray, "pairs 2"]
    """Indices of masks of the same object in two views."""


class Gaps(NamedTuple):
    """Differences between the ranges of planes of the two masks of each pair, at both ends."""

    gaps_px: Float[np.ndarray, "pairs 2"]
    """Distance of the first mask's end inside the second's, in pixels: negative if the first mask
    is the wider one. The two masks share the error according to how far the end is from the other
    camera in either image."""
    clear: Bool[np.ndarray, "pairs 2 2"]
    """True if the end (second axis) is the object's own in the first and second mask (last
    axis)."""
    slopes: Float[np.ndarray, "pairs 2 12"]
    """Derivatives of `gaps_px` by small turns of the first camera about its centre and by its
    moves, both along the world's axes, then by those of the second camera."""
    widths_px: Float[np.ndarray, "pairs 2"]
    """Widths of the ranges of the first and the second mask."""
    valid: Bool[np.ndarray, " pairs"]
    """False if the cameras are too near to each other, or one stands before the object."""

    @property
    def used(self) -> Bool[np.ndarray, "pairs 2"]:
        """True for the ends that can be compared."""
        return self.valid[:, None] & self.clear.all(axis=2)

    @property
    def used_px(self) -> Float[np.ndarray, " ends"]:
        """Sizes of the gaps at these ends."""
        return np.abs(self.gaps_px[self.used])

    @property
    def median_px(self) -> float:
        return float(np.median(self.used_px)) if self.used.any() else 0.0


class Corrected(NamedTuple):
    """Views of a room whose masks agree better."""

    world_to_camera: Float[np.ndarray, "views 4 4"] | None
    """None if the poses stay as they are."""
    seen: Observations
    """Masks that show more than their object, such as two objects that are merged, are void."""
    notes: list[str]


def correct(
    seen: Observations,
    world_to_camera: Float[np.ndarray, "views 4 4"],
    intrinsics: Float[np.ndarray, "views 3 3"],
) -> Corrected:
    """Compare the masks of each object in all pairs of views, and correct what they contradict.

    Poses stay as they are if they agree with the masks, or if no small correction makes them agree.
    The room as a whole keeps its place. If no mask is wrong, `seen` is returned itself.
    """
    outlines = find_outlines(seen, intrinsics)
    notes: list[str] = []
    poses = world_to_camera.astype(np.float64)
    change = _adjusted(outlines, poses)
    gaps = measure_gaps(outlines, poses, np.zeros_like(change))
    corrected = measure_gaps(outlines, poses, change)
    before, after = gaps.median_px, corrected.median_px
    moved = None
    if before > WRONG_PX and after <= _FIT_PX and _poses_err(outlines, poses):
        moved, gaps = camera_at(*_changed(poses, change)), corrected
        turned, shifted = (np.median(np.linalg.norm(part, axis=1)) for part in np.hsplit(change, 2))
        notes.append(
            f"poses are corrected by {np.degrees(turned):.2f} degrees and {100 * shifted:.1f} cm "
            f"(medians): outlines now agree to {after:.2f} pixels, before to {before:.2f}"
        )
    wrong = wrong_masks(outlines, gaps)
    if gaps.median_px <= _FIT_PX and wrong.any():
        images, void = seen.instance_ids.astype(np.uint32), len(seen.object_class) + 1
        for view, item in zip(outlines.view[wrong], outlines.item[wrong], strict=True):
            images[view][images[view] == item + 1] = void
        seen = observe(images, np.append(seen.object_class, VOID))
        notes.append(f"{wrong.sum()} masks show more than other views of their object: void")
    return Corrected(moved, seen, notes)


def _poses_err(outlines: Outlines, poses: np.ndarray) -> bool:
    """True if a correction that fits some objects makes others agree, too, as no overfitting does.

    The objects are halved by their numbers, and each half is judged by the other's correction.
    """
    odd = outlines.item[outlines.pairs[:, 0]] % 2 == 1
    given: list[np.ndarray] = []
    corrected: list[np.ndarray] = []
    for half in (odd, ~odd):
        change = _adjusted(outlines._replace(pairs=outlines.pairs[half]), poses)
        others = outlines._replace(pairs=outlines.pairs[~half])
        for sizes, each in ((given, 0 * change), (corrected, change)):
            sizes.append(measure_gaps(others, poses, each).used_px)
    before, after = (np.concatenate(sizes) for sizes in (given, corrected))
    enough = min(len(before), len(after)) >= _LEAST_GAPS
    return bool(enough and np.median(after) < LESS * np.median(before))


def _changed(poses: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and centres of cameras after each is turned about its centre by a rotation vector,
    then moved, both along the world's axes; `change` is (views, 6)."""
    turns = Rotation.from_rotvec(change[:, :3]).as_matrix()
    return poses[:, :3, :3] @ turns.transpose(0, 2, 1), camera_centers(poses) + change[:, 3:]


def _adjusted(outlines: Outlines, poses: np.ndarray) -> Float[np.ndarray, "views 6"]:
    """Turns and moves of all cameras that minimise the gaps, by Gauss-Newton steps.

    Gaps are weighted as by Geman and McClure: one that is much larger than the others, as at an
    end that is hidden unnoticed, has almost no weight.
    """
    views = len(poses)
    change = np.zeros((views, 6))
    held = np.diag(np.repeat([TURN_RAD, MOVE_M], 3) ** -2.0)
    cameras = outlines.view[outlines.pairs]
    for _ in range(_ROUNDS):
        gaps = measure_gaps(outlines, poses, change)
        scale = max(_SCALE_PX, gaps.median_px)
        weights = np.where(gaps.used, (1 + (gaps.gaps_px / scale) ** 2) ** -2, 0.0)
        slopes = gaps.slopes.reshape(*gaps.gaps_px.shape, 2, 6)
        square = np.zeros((views, views, 6, 6))
        pull = -change @ held
        for i in range(2):
            one = slopes[:, :, i] * weights[..., None]
            np.subtract.at(pull, cameras[:, i], np.einsum("pe,pei->pi", gaps.gaps_px, one))
            for j in range(2):
                both = np.einsum("pei,pej->pij", one, slopes[:, :, j])
                np.add.at(square, (cameras[:, i], cameras[:, j]), both)
        square[np.arange(views), np.arange(views)] += held
        matrix = square.transpose(0, 2, 1, 3).reshape(6 * views, 6 * views)
        change = change + np.linalg.solve(matrix, pull.ravel()).reshape(views, 6)
    return change.round(_DIGITS)


def wrong_masks(outlines: Outlines, gaps: Gaps) -> Bool[np.ndarray, " masks"]:
    """True for masks that are too wide for most of the object's masks in other views.

    A mask that is too narrow may be correct, if the object is partly occluded in this view; one
    that is too wide shows something besides the object.
    """
    told, against = np.zeros((2, len(outlines.view)), dtype=np.int64)
    for mine, other, wider_px in ((0, 1, -gaps.gaps_px), (1, 0, gaps.gaps_px)):
        limit_px = np.maximum(_TOO_WIDE_PX, _TOO_WIDE * gaps.widths_px[:, other])
        known = gaps.clear[:, :, other] & gaps.valid[:, None]
        too_wide = (known & (wider_px > limit_px[:, None])).any(axis=1)
        np.add.at(told, outlines.pairs[:, mine], known.any(axis=1))
        np.add.at(against, outlines.pairs[:, mine], too_wide)
    return (told >= _LEAST_PAIRS) & (against > _MOST_AGAINST * told)


def find_outlines(seen: Observations, intrinsics: Float[np.ndarray, "views 3 3"]) -> Outlines:
    """Convex hulls of all visible masks; `intrinsics` are in pixels of the images."""
    rays, clear, names = [], [], []
    for view, image in enumerate(seen.instance_ids):
        places = ndimage.find_objects(image)
        for item in np.flatnonzero(seen.visible[view]).tolist():
            corners = hull_corners(image, item + 1, places[item])
            other = (image != 0) & (image != item + 1)
            inner = ((corners > 1) & (corners < np.array(image.shape[::-1]) - 1)).all(axis=1)
            around = [
                other[max(y - TOUCH_PX, 0) : y + TOUCH_PX, max(x - TOUCH_PX, 0) : x + TOUCH_PX]
                for x, y in corners.tolist()
            ]
            clear.append(inner & ~np.array([part.any() for part in around]))
            points = np.concatenate([corners, np.ones((len(corners), 1))], axis=1)
            points = points @ np.linalg.inv(intrinsics[view].astype(np.float64)).T
            rays.append(points / np.linalg.norm(points, axis=1, keepdims=True))
            names.append((view, item))
    most = max((len(corners) for corners in rays), default=1)
    of_view, of_item = np.array(names, dtype=np.int64).reshape(-1, 2).T
    pairs = np.argwhere((of_item[:, None] == of_item) & (of_view[:, None] < of_view))
    return Outlines(
        np.stack([np.pad(each, ((0, most - len(each)), (0, 0)), mode="edge") for each in rays]),
        np.stack([np.pad(each, (0, most - len(each)), mode="edge") for each in clear]),
        of_view, of_item, intrinsics[of_view, 0, 0].astype(np.float64),
        pairs[:: max(1, -(-len(pairs) // PAIRS_AT_MOST))],
    )  # fmt: skip


def hull_corners(
    image: np.ndarray, number: int, place: tuple[slice, slice]
) -> Int[np.ndarray, "corners 2"]:
    """Corners x, y of the convex hull of a mask's pixels; `place` are its rows and columns."""
    own = image[place] == number
    y = np.flatnonzero(own.any(axis=1))
    left, right = own[y].argmax(axis=1), own.shape[1] - own[y, ::-1].argmax(axis=1)
    ends = np.concatenate(
        [np.stack([x, y + below], axis=1) for x in (left, right) for below in (0, 1)]
    )
    return ends[ConvexHull(ends).vertices] + [place[1].start, place[0].start]


def measure_gaps(
    outlines: Outlines,
    world_to_camera: Float[np.ndarray, "views 4 4"],
    change: Float[np.ndarray, "views 6"],
) -> Gaps:
    """Measure all pairs after a change of the cameras: turns about their centres, then moves."""
    rotations, centers_m = _changed(world_to_camera, change)
    directions = outlines.rays @ rotations[outlines.view]
    first, second = outlines.pairs.T
    step_m = centers_m[outlines.view[second]] - centers_m[outlines.view[first]]
    length_m = np.maximum(np.linalg.norm(step_m, axis=1), 1e-9)
    axis = step_m / length_m[:, None]
    masks = directions[first], directions[second]
    middle = masks[0].mean(axis=1) + masks[1].mean(axis=1)
    ahead = middle - (middle * axis).sum(axis=1, keepdims=True) * axis
    ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    aside = np.cross(axis, ahead)

    rows = np.arange(len(first))[:, None]
    ends, turns, px_per_rad, clear, spread = [], [], [], [], []
    for mask, rays in zip((first, second), masks, strict=True):
        x, y = (np.einsum("pci,pi->pc", rays, side) for side in (ahead, aside))
        angle = np.arctan2(y, x)
        spread.append(np.abs(angle).max(axis=1))
        at = np.stack([angle.argmin(axis=1), angle.argmax(axis=1)], axis=1)
        ends.append(angle[rows, at])
        clear.append(outlines.clear[mask[:, None], at])
        away = np.maximum(np.hypot(x, y)[rows, at], 1e-9)
        px_per_rad.append(outlines.focal_px[mask][:, None] * away)
        along = np.einsum("pei,pi->pe", rays[rows, at], axis)[..., None]
        across = rays[rows, at] - along * axis[:, None]
        # The change of the angle with a turn of the camera about each of the world's axes.
        turns.append(axis[:, None] - along * across / away[..., None] ** 2)

    inwards = np.array([1.0, -1.0])
    scale = 1 / np.sqrt(px_per_rad[0] ** -2 + px_per_rad[1] ** -2)
    # A move of a camera turns the axis, as a turn of both cameras the other way would.
    moves = np.cross(turns[0] - turns[1], axis[:, None]) / length_m[:, None, None]
    slopes = np.concatenate([turns[0], moves, -turns[1], -moves], axis=2)
    return Gaps(
        (ends[0] - ends[1]) * scale * inwards,
        np.stack(clear, axis=2),
        slopes * (scale * inwards)[..., None],
        np.stack([np.ptp(end, axis=1) for end in ends], axis=1) * scale.mean(axis=1)[:, None],
        (length_m > _BASELINE_M) & (np.maximum(*spread) < _WIDEST_RAD),
    )
