"""Corrects the poses of a room that its masks contradict, and finds the masks that are wrong."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from data_prep.readers.tangents import Gaps, Outlines, find_outlines, measure_gaps
from sceneprior.core.cameras import camera_at, camera_centers
from sceneprior.core.classes import VOID
from sceneprior.core.observations import Observations, observe

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
_MOST_AGREE, _LEAST_PAIRS = 0.6, 4
"""A mask is wrong if it is too wide for more than this share of the object's other masks, of which
at least so many can be compared."""
_DIGITS = 6
"""Decimals of a correction, in radians and metres, so that last bits of sums do not matter."""


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
    poses, as_given = world_to_camera.astype(np.float64), np.zeros((len(world_to_camera), 6))
    change = _adjusted(outlines, poses)
    gaps, corrected = (_gaps(outlines, poses, each) for each in (as_given, change))
    before, after = _median_px(gaps), _median_px(corrected)
    moved = None
    if before > WRONG_PX and after <= _FIT_PX and _poses_err(outlines, poses):
        moved, gaps = moved_cameras(poses, change), corrected
        turned, shifted = (np.median(np.linalg.norm(part, axis=1)) for part in np.hsplit(change, 2))
        notes.append(
            f"poses are corrected by {np.degrees(turned):.2f} degrees and {100 * shifted:.1f} cm "
            f"(medians): outlines now agree to {after:.2f} pixels, before to {before:.2f}"
        )
    wrong = wrong_masks(outlines, gaps)
    if _median_px(gaps) <= _FIT_PX and wrong.any():
        seen = _without(seen, outlines, wrong)
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
            gaps = _gaps(others, poses, each)
            sizes.append(np.abs(gaps.gaps_px[_used(gaps)]))
    before, after = (np.concatenate(sizes) for sizes in (given, corrected))
    enough = min(len(before), len(after)) >= _LEAST_GAPS
    return bool(enough and np.median(after) < LESS * np.median(before))


def _without(seen: Observations, outlines: Outlines, wrong: np.ndarray) -> Observations:
    images, void = seen.instance_ids.astype(np.uint32), len(seen.object_class) + 1
    for view, item in zip(outlines.view[wrong], outlines.item[wrong], strict=True):
        images[view][images[view] == item + 1] = void
    return observe(images, np.append(seen.object_class, VOID))


def moved_cameras(
    world_to_camera: Float[np.ndarray, "views 4 4"], change: Float[np.ndarray, "views 6"]
) -> Float[np.ndarray, "views 4 4"]:
    """Turn each camera about its centre by a rotation vector, then move it, along world axes."""
    rotations, centers_m = _changed(world_to_camera, change)
    return camera_at(rotations, centers_m)


def _changed(poses: np.ndarray, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations and centres of cameras after a change."""
    turns = Rotation.from_rotvec(change[:, :3]).as_matrix()
    centers_m = camera_centers(poses)
    return poses[:, :3, :3] @ turns.transpose(0, 2, 1), centers_m + change[:, 3:]


def _gaps(outlines: Outlines, poses: np.ndarray, change: np.ndarray) -> Gaps:
    return measure_gaps(outlines, *_changed(poses, change))


def _used(gaps: Gaps) -> Bool[np.ndarray, "pairs 2"]:
    return gaps.valid[:, None] & gaps.clear.all(axis=2)


def _median_px(gaps: Gaps) -> float:
    sizes = np.abs(gaps.gaps_px[_used(gaps)])
    return float(np.median(sizes)) if len(sizes) else 0.0


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
        gaps = _gaps(outlines, poses, change)
        scale = max(_SCALE_PX, _median_px(gaps))
        weights = np.where(_used(gaps), (1 + (gaps.gaps_px / scale) ** 2) ** -2, 0.0)
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
    return (told >= _LEAST_PAIRS) & (against > _MOST_AGREE * told)
