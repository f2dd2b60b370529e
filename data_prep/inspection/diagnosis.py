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
from data_prep.inspection.camera_convention import Convention
from data_prep.inspection.causes import (
    CHANCE,
    FOCAL_STEPS,
    GIVEN,
    TABLE,
    Cause,
    corrections,
    sentence_of,
)
from data_prep.inspection.evidence import Evidence, fit, middles
from data_prep.inspection.messages import UNITS_M, wrong_ids, wrong_unit, wrong_up
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
_EYES_M, _LENGTHS_M = (0.2, 4.0), (0.15, 6.0)
"""Plausible ranges of the median camera height and of the median length of objects."""
_SOME_LENGTHS = 3
"""Minimum number of objects for testing lengths: a single object may be badly visible."""
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


class TrackTrial(NamedTuple):
    """Summed agreement and number of box middles, with the given ids and with objects found."""

    given: float
    given_middles: int
    found: float
    found_middles: int

    @property
    def repairs(self) -> bool:
        """True if the objects found fit the cameras, and explain more than the given ids."""
        fits = self.found > _GOOD * self.found_middles
        # With right poses and wrong ids, most masks join others; with wrong poses, hardly any do.
        return fits and self.found > _GAIN * self.given and 2 * self.found > self.given_middles


def try_tracks(rooms: Iterable[RoomViews]) -> TrackTrial:
    """Find the objects of rooms, read with images, without ids and classes, and compare."""
    trials = [(*_fit(views), *_fit(_retracked(views))) for views in rooms]
    return TrackTrial(*map(sum, zip(*trials, strict=True)))


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


def _fit(views: RoomViews) -> tuple[float, int]:
    found = middles(views)
    poses, lenses = views.world_to_camera[None], views.intrinsics[None]
    agreement, _ = fit(found, poses.astype(np.float64), lenses.astype(np.float64))
    return float(agreement.sum()), len(found.item)


def margin(evidence: Evidence) -> float:
    """Minimum difference in mean agreement that is significant."""
    return _MARGIN + _MARGIN_OF_ONE / max(evidence.spare, 1) ** 0.5


def camera_cause(evidence: Evidence) -> Cause | None:
    """Cause whose correction makes masks and cameras agree clearly better, if there is one."""
    if evidence.spare < _SPARE_AT_LEAST:
        return None
    causes = [cause for cause in evidence.sums if cause != CHANCE]
    best = max(causes, key=lambda cause: round(evidence.share(cause), 2))  # the first of equals
    gain = evidence.share(best) - evidence.share(GIVEN)
    return best if gain > margin(evidence) and evidence.share(best) >= _GOOD else None


def find_mistake(
    evidence: Evidence, convention: Convention, track: Callable[[], TrackTrial]
) -> Finding | None:
    """The likeliest mistake; `track` is called only if the ids may be wrong."""
    fit = evidence.share(GIVEN)
    if evidence.views <= evidence.rooms:
        return Finding(
            "views",
            "there is only one frame per room, which shows no depth: give at least two from "
            "different places, better twenty",
        )
    if evidence.ids >= _SOME_IDS and evidence.once > _ONCE * evidence.ids and evidence.views > 2:
        why = f"{evidence.once} of {evidence.ids} ids are in one image only"
        return Finding("ids", wrong_ids(evidence.counts, why, convention))
    if (cause := camera_cause(evidence)) is not None:
        said = f"{fit:.2f} as given, {evidence.share(cause):.2f} corrected"
        sentence = f"{sentence_of(cause, convention)} (fit of masks and poses: {said})"
        return Finding(cause, sentence)
    doubted = evidence.spare >= _SPARE_AT_LEAST and fit < _GOOD
    if doubted and (trial := track()).repairs:
        why = (
            f"fit of masks and poses: {trial.given / max(trial.given_middles, 1):.2f} with these "
            f"ids, {trial.found / trial.found_middles:.2f} with objects found without them"
        )
        return Finding("ids", wrong_ids(evidence.counts, why, convention))
    if doubted and fit + margin(evidence) / 2 < _FIT_AT_LEAST:
        return _unexplained(evidence, convention)
    return _implausible(evidence, convention)


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
    """Find an unusual direction, height or length, which masks alone do not determine."""
    axis = int(np.abs(evidence.tops).argmax())
    if abs(evidence.tops[axis]) > 0.5 and evidence.tops[1] <= 0.5:
        return Finding("up", wrong_up(axis, float(np.sign(evidence.tops[axis])), convention))
    length_m = evidence.length_m if evidence.measured >= _SOME_LENGTHS else None
    for what, value, bounds in (
        ("the cameras stand {} above the floor", evidence.eye_m, _EYES_M),
        ("the objects are {} long", length_m, _LENGTHS_M),
    ):
        if value is not None and not bounds[0] <= value <= bounds[1]:
            factor = _metres_per_unit(evidence) if convention.posed else None
            return Finding(("unit", factor), wrong_unit(what, value, bounds, factor))
    if evidence.floor_m is not None and abs(evidence.floor_m) > _FLOOR_M:
        side = "above" if evidence.floor_m > 0 else "below"
        cure = "is the floor at y = 0?"
        if convention.posed:
            cure = "correct or leave out floor_m, or --floor-m (the floor is then estimated)"
        off = f"{abs(evidence.floor_m):.2f} m {side} the floor"
        return Finding("floor", f"the lowest objects end {off}: {cure}")
    return None


def _metres_per_unit(evidence: Evidence) -> float | None:
    """Metres per unit at which furniture is about 0.9 m long; None if no unit is plausible."""
    if evidence.length_m is None:
        return None
    lengths = {factor: evidence.length_m * factor for factor in UNITS_M.values()}
    best = min(lengths, key=lambda factor: abs(np.log(lengths[factor] / 0.9)))
    return best if 0.4 < lengths[best] < 2 else None


def what_was_checked(evidence: Evidence) -> tuple[list[str], list[str]]:
    """Parts of sentences on the camera errors that masks exclude, and on those they do not."""
    fit, least = evidence.share(GIVEN), margin(evidence)

    def excluded(causes: list[Cause]) -> bool:
        enough = evidence.spare >= _SPARE_AT_LEAST
        return enough and all(fit - evidence.share(cause) > least for cause in causes)

    of: dict[str, list[Cause]] = {name: [] for name in TABLE}
    for cause in evidence.sums:
        if cause.name != "order" or "sorted" not in cause.detail:  # equal for few frames
            of[cause.name].append(cause)
    yes: list[str] = []
    no: list[str] = []
    for name, causes in (
        ("matrices of another kind or with other axes", of["poses"]),
        ("poses of other frames", [*of["order"], *of["chance"]]),
        (
            "a principal point off by 30% of the picture",
            [cause for cause in of["center"] if max(map(abs, cause.detail)) > 0.2],
        ),
    ):
        (yes if excluded(causes) else no).append(name)
    for step in sorted({abs(step) for step in FOCAL_STEPS}):
        if excluded([c for c in of["focal"] if abs(np.log2(c.detail)) > (step - 0.5) / 6]):
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
    sums: dict[str, Agreement] = {}
    names: dict[str, str] = {}
    for room, convention in rooms:
        for cause, other in corrections(room, convention).items():
            if TABLE[cause.name].with_truth:
                sentence = sentence_of(cause, convention)
                sums[sentence] = added([sums.get(sentence, {}), compare(other).agreement])
                # Factors of different rooms differ by less than is printed: the first is kept.
                names.setdefault(sentence, TABLE[cause.name].corrected.format(cause.detail))
    empty = Tally(tally.kind)
    good = {
        sentence: found for sentence, found in sums.items()
        if found.get(tally.kind, empty).passes(limits)
    }  # fmt: skip
    if not good:
        return f"{text}: is an axis or a unit wrong?"
    best = max(good, key=lambda sentence: round(score(good[sentence]), 2))  # the first of equals
    after = good[best].get(tally.kind, empty)
    text += f": {best}; {names[best]}, {after.share:.0%} would"
    return text + (f", with a mean 2D IoU of {after.mean_iou:.2f}" if after.whole else "")


def outliers(seen: Comparison) -> Iterator[str]:
    """Report views and objects that disagree in a room that agrees as a whole."""
    count, held = seen.judged.sum(axis=1), (seen.judged & seen.held).sum(axis=1)
    wrong = np.flatnonzero((count >= 2) & (held < _OUTLIER * count))
    if len(wrong):
        shown = ", ".join(str(view) for view in wrong[:6])
        more = f" and {len(wrong) - 6} more" if len(wrong) > 6 else ""
        yield (
            f"{held[wrong].sum()} of the {count[wrong].sum()} masks of views {shown}{more} lie "
            "within their projections, in other views nearly all do: are their poses wrong, or "
            "those of other frames?"
        )
        return
    seen_in = seen.judged.sum(axis=0)
    lost = (seen.judged & ~seen.held).sum(axis=0)
    for k in np.flatnonzero((seen_in >= 3) & (lost > _OUTLIER * seen_in)):
        yield (
            f"object {k} is not where its ground truth has it: {lost[k]} of its {seen_in[k]} "
            "masks reach beyond its projection, unlike those of other objects"
        )
