"""Names the likeliest mistake of a folder or a room, without and with 3D ground truth."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import numpy as np

from data_prep.inspection.agreement import (
    HELD_AT_LEAST,
    IOU_AT_LEAST,
    KINDS,
    Agreement,
    Comparison,
    Limits,
    Room,
    Tally,
    added,
    compare,
    score,
)
from data_prep.inspection.causes import (
    CHANCE,
    FOCAL_STEPS,
    GIVEN,
    Cause,
    Convention,
    corrections,
    sentence_of,
)
from data_prep.inspection.evidence import Evidence, fit, middles
from data_prep.tracks.associate import UNKNOWN, FrameMasks, associate
from sceneprior.core.classes import VOID
from sceneprior.core.observations import RoomViews, observe

_SPARE_AT_LEAST = 12
"""Minimum number of spare middles (`Evidence.spare`) for comparing cameras."""
_MARGIN, _MARGIN_OF_ONE = 0.05, 0.5
"""A correction must raise the mean agreement by the first number, plus the second divided by the
square root of the number of spare middles."""
_FIT_AT_LEAST = 0.5
"""Mean agreement below which cameras and masks do not fit. Correct rooms reach 0.75 to 0.95; with
errors of 3 cm and 1.5 degrees, 0.7; with shuffled cameras, 0.2."""
_GOOD = 0.6
"""Mean agreement that a correction must reach, and below which the ids are tested."""
_GAIN = 1.3
"""Minimum ratio of the agreement of objects found without ids to that of the given ids."""
_NEARNESS = 0.1
"""Mean correlation below which poses belong to other frames; correct rooms have 0.1 to 0.7."""
_EYES_M = 0.2, 4.0
"""Plausible range of the median camera height."""
_SAME_SCALE = 0.4
"""Step of the logarithm of a wrong scale within which rooms have the same mistake."""
_FLOOR_M = 0.15
_ONCE, _SOME_IDS = 0.8, 8
"""Share of ids that occur in a single view above which ids are not tracked, and the minimum number
of ids for this test."""
_OUTLIER = 0.5
"""Share of agreeing masks below which a view or object is reported, in a room that agrees as a
whole."""


class Finding(NamedTuple):
    """A mistake: a key that is equal for rooms with the same mistake, and a sentence."""

    key: object
    sentence: str


def find_mistake(
    evidence: Evidence, convention: Convention, rooms: Callable[[], Iterable[RoomViews]]
) -> Finding | None:
    """The likeliest mistake; `rooms` reads some with images, and only if ids may be wrong."""
    fit, least = evidence.share(GIVEN), margin(evidence)
    if evidence.views <= evidence.rooms:
        return Finding(
            "views",
            "there is only one frame per room, which shows no depth: give at least two from "
            "different places, better twenty",
        )
    if evidence.ids >= _SOME_IDS and evidence.once > _ONCE * evidence.ids and evidence.views > 2:
        why = f"{evidence.once} of {evidence.ids} ids are in one image only"
        return _wrong_ids(evidence, why, convention)
    if evidence.spare >= _SPARE_AT_LEAST:
        causes = [cause for cause in evidence.sums if cause != CHANCE]
        cause = max(causes, key=lambda cause: round(evidence.share(cause), 2))  # first of equals
        best = evidence.share(cause)
        if best - fit > least and best >= _GOOD:
            said = f"(fit of masks and poses: {fit:.2f} as given, {best:.2f} corrected)"
            return Finding(cause, f"{sentence_of(cause, convention)} {said}")
        if fit < _GOOD and (why := _tracked_better(rooms())):
            return _wrong_ids(evidence, why, convention)
        if fit < _GOOD and fit + least / 2 < _FIT_AT_LEAST:
            return _unexplained(evidence, convention)
    return _implausible(evidence, convention)


def margin(evidence: Evidence) -> float:
    """Minimum difference in mean agreement that is significant."""
    return _MARGIN + _MARGIN_OF_ONE / max(evidence.spare, 1) ** 0.5


def _wrong_ids(evidence: Evidence, why: str, convention: Convention) -> Finding:
    posed = "pass --tracks auto, which finds the objects"
    return Finding(
        "ids",
        f"the ids of the masks are not those of objects in all frames ({evidence.counts}; {why}): "
        f"{posed if convention.posed else 'are they shuffled?'}",
    )


def _tracked_better(rooms: Iterable[RoomViews]) -> str:
    """Find the objects of rooms without ids and classes. If they fit the cameras and explain more
    than the given ids, say how well both fit; else ""."""
    sums = np.zeros((2, 2))
    for views in rooms:
        poses = views.world_to_camera[None].astype(np.float64)
        lenses = views.intrinsics[None].astype(np.float64)
        for row, of_ids in enumerate((views, _retracked(views))):
            seen = middles(of_ids)
            sums[row] += float(fit(seen, poses, lenses).sum()), len(seen.item)
    (given, of_given), (found, of_found) = sums.tolist()
    # With right poses and wrong ids, most masks join others; with wrong poses, hardly any do.
    if found > _GOOD * of_found and found > _GAIN * given and 2 * found > of_given:
        return (
            f"fit of masks and poses: {given / max(of_given, 1):.2f} with these ids, "
            f"{found / of_found:.2f} with objects found without them"
        )
    return ""


def _retracked(views: RoomViews) -> RoomViews:
    assert views.instance_ids is not None
    void = len(views.object_class) + 1
    ids = np.where(views.instance_ids == void, UNKNOWN, 0).astype(np.int32)
    count = 0
    for view, image in enumerate(views.instance_ids):
        for k in np.unique(image[(image > 0) & (image < void)]).tolist():
            count += 1
            ids[view][image == k] = count
    # All masks get one class, because the classes of wrong ids would be wrong.
    masks = FrameMasks(ids, np.ones(count, dtype=np.int64))
    tracks = associate(masks, views.world_to_camera, views.intrinsics)
    objects = len(tracks.object_class)
    images = np.where(tracks.ids < 0, objects + 1, tracks.ids).astype(np.uint32)
    seen = observe(images, [*tracks.object_class.tolist(), VOID])
    return seen.room_views(views.room_id, views.world_to_camera, views.intrinsics)


def _unexplained(evidence: Evidence, convention: Convention) -> Finding:
    said = (
        f"fit {evidence.share(GIVEN):.2f}, with shuffled poses {evidence.share(CHANCE):.2f}, "
        f"expected at least {_FIT_AT_LEAST:g}"
    )
    if evidence.nearness is not None and evidence.nearness < _NEARNESS:
        return Finding(
            "frames",
            f"the poses in {convention.file} belong to other frames than the masks ({said}; "
            "cameras that are turned alike do not show the same objects): pair each pose with its "
            "picture",
        )
    return Finding(
        "unknown",
        f"masks and poses in {convention.file} do not fit ({said}), and no known mistake explains "
        "it: are the poses those of these pictures, and exact to a few centimetres?",
    )


def _implausible(evidence: Evidence, convention: Convention) -> Finding | None:
    """Find an unusual direction, size or height, which masks alone do not determine."""
    axis = int(np.abs(evidence.tops).argmax())
    if abs(evidence.tops[axis]) > 0.5 and evidence.tops[1] <= 0.5:
        along = np.sign(evidence.tops[axis]) * convention.room_from_world[axis, :3]
        place = int(np.abs(along).argmax())
        name = "xyz"[place] if along[place] > 0.9 else ""
        cure = f"pass --up {name}" if convention.posed and name in ("y", "z") else "turn the poses"
        where = f"along the {name} axis" if name else "in another direction"
        return Finding(
            "up",
            f"the tops of the pictures point {where} of {convention.file}, which is not the axis "
            f"that was taken as up: {cure}",
        )
    if (scale := evidence.scale) is not None and scale.is_wrong:
        key = "scale", round(np.log(scale.factor) / _SAME_SCALE)
        return Finding(key, sentence_of(Cause("scale", scale), convention))
    low, high = _EYES_M
    if not low <= evidence.eye_m <= high:
        unit = " (--metres-per-unit)" * convention.posed
        return Finding(
            "unit",
            f"the cameras stand {evidence.eye_m:.3g} m above the floor in the median, expected "
            f"{low:g} to {high:g} m: are the poses in metres{unit}, and is the floor at the right "
            "height?",
        )
    if evidence.floor_m is not None and abs(evidence.floor_m) > _FLOOR_M:
        side = "above" if evidence.floor_m > 0 else "below"
        cure = "is the floor at y = 0?"
        if convention.posed:
            cure = "correct or leave out floor_m, or --floor-m (the floor is then estimated)"
        off = f"{abs(evidence.floor_m):.2f} m {side} the floor"
        return Finding("floor", f"the lowest objects end {off}: {cure}")
    return None


def what_was_checked(evidence: Evidence) -> tuple[list[str], list[str]]:
    """Parts of sentences on the camera errors that masks exclude, and on those they do not."""
    below = evidence.share(GIVEN) - margin(evidence)

    def excluded(name: str, counts: Callable[[Cause], bool] = lambda cause: True) -> bool:
        causes = [cause for cause in evidence.sums if cause.name == name and counts(cause)]
        enough = evidence.spare >= _SPARE_AT_LEAST
        return enough and all(evidence.share(cause) < below for cause in causes)

    kinds = {
        "matrices of another kind or with other axes": excluded("poses"),
        # Frames sorted as text and by number are in the same order if there are few.
        "poses of other frames": excluded("chance")
        and excluded("order", lambda cause: "sorted" not in cause.detail),
        "a principal point off by 30% of the picture": excluded(
            "center", lambda cause: max(map(abs, cause.detail)) > 0.2
        ),
    }
    yes, no = ([name for name in kinds if kinds[name] is found] for found in (True, False))
    for step in sorted({abs(step) for step in FOCAL_STEPS}):

        def far(cause: Cause, least: float = (step - 0.5) / 6) -> bool:
            return bool(abs(np.log2(cause.detail)) > least)

        if excluded("focal", far):
            yes.append(f"focal lengths {2 ** (step / 6):.2g} times as long or as short")
            break
    else:
        no.append("wrong focal lengths")
    return yes, no


def disagreement(tally: Tally, rooms: Iterable[tuple[Room, Convention]], limits: Limits) -> str:
    """State that masks and 3D objects disagree, and name the likely cause; no final full stop.

    Corrections are tried on `rooms`; the best that passes the limits is the cause.
    """
    text = (
        f"{tally.share:.0%} of {tally.masks} masks lie within the projected {KINDS[tally.kind]}, "
        f"expected at least {limits.share * HELD_AT_LEAST[tally.kind]:.0%}"
    )
    if tally.whole:
        text += (
            f", and those of unoccluded objects overlap with a mean 2D IoU of {tally.mean_iou:.2f}"
            f", expected at least {limits.share * IOU_AT_LEAST[tally.kind]:.2f}"
        )
    sums: dict[str, tuple[str, Agreement]] = {}
    for room, convention in rooms:
        for cause, other in corrections(room, convention).items():
            if cause.name not in ("given", "center", "chance"):
                sentence = sentence_of(cause, convention)
                how = f"times {cause.detail:.2g}" if cause.name == "unit" else "corrected"
                # Factors of different rooms differ by less than is printed: the first is kept.
                how, before = sums.get(sentence, (how, {}))
                sums[sentence] = how, added([before, compare(other).agreement])
    empty = Tally(tally.kind)
    good = [
        (sentence, how, found) for sentence, (how, found) in sums.items()
        if found.get(tally.kind, empty).passes(limits)
    ]  # fmt: skip
    if not good:
        return f"{text}: is an axis or a unit wrong?"
    best, how, found = max(good, key=lambda each: round(score(each[2]), 2))  # the first of equals
    after = found.get(tally.kind, empty)
    text += f": {best}; {how}, {after.share:.0%} would"
    return text + (f", with a mean 2D IoU of {after.mean_iou:.2f}" if after.whole else "")


def outliers(seen: Comparison) -> Iterator[str]:
    """Report views and objects that disagree in a room that agrees as a whole."""
    held = seen.judged & seen.held
    count, within = seen.judged.sum(axis=1), held.sum(axis=1)
    wrong = np.flatnonzero((count >= 2) & (within < _OUTLIER * count))
    if len(wrong):
        shown = ", ".join(str(view) for view in wrong[:6])
        more = f" and {len(wrong) - 6} more" if len(wrong) > 6 else ""
        yield (
            f"{within[wrong].sum()} of the {count[wrong].sum()} masks of views {shown}{more} lie "
            "within their projections, in other views nearly all do: are their poses wrong, or "
            "those of other frames?"
        )
        return
    count = seen.judged.sum(axis=0)
    lost = count - held.sum(axis=0)
    for k in np.flatnonzero((count >= 3) & (lost > _OUTLIER * count)):
        yield (
            f"object {k} is not where its ground truth has it: {lost[k]} of its {count[k]} "
            "masks reach beyond its projection, unlike those of other objects"
        )
