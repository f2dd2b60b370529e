"""Names the likeliest mistake from the evidence of rooms, or else states what was checked."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from data_prep.inspection.causes import CHANCE, FOCAL_STEPS, GIVEN, Cause
from data_prep.inspection.evidence import Evidence
from data_prep.inspection.given import Given
from data_prep.inspection.tracking import Trial
from data_prep.inspection.words import UNITS_M, of_cause, of_ids, of_unit, of_up

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


class Finding(NamedTuple):
    """A mistake: a key that is equal for rooms with the same mistake, and a sentence."""

    key: object
    sentence: str


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
    evidence: Evidence, given: Given, try_tracks: Callable[[], Trial]
) -> Finding | None:
    """The likeliest mistake; `try_tracks` is called only if the ids may be wrong."""
    fit = evidence.share(GIVEN)
    if evidence.views <= evidence.rooms:
        return Finding(
            "views",
            "there is only one frame per room, which shows no depth: give at least two from "
            "different places, better twenty",
        )
    if evidence.ids >= _SOME_IDS and evidence.once > _ONCE * evidence.ids and evidence.views > 2:
        why = f"{evidence.once} of {evidence.ids} ids are in one image only"
        return Finding("ids", of_ids(evidence, why, given))
    if (cause := camera_cause(evidence)) is not None:
        said = f"{fit:.2f} as given, {evidence.share(cause):.2f} corrected"
        return Finding(cause, f"{of_cause(cause, given)} (fit of masks and poses: {said})")
    doubted = evidence.spare >= _SPARE_AT_LEAST and fit < _GOOD
    if doubted and (trial := try_tracks()).repairs:
        said = f"{trial.given / max(trial.given_middles, 1):.2f} with these ids, "
        said += f"{trial.found / trial.found_middles:.2f} with objects found without them"
        return Finding("ids", of_ids(evidence, f"fit of masks and poses: {said}", given))
    if doubted and fit + margin(evidence) / 2 < _FIT_AT_LEAST:
        return _unexplained(evidence, given)
    return _implausible(evidence, given)


def _unexplained(evidence: Evidence, given: Given) -> Finding:
    said = (
        f"fit {evidence.share(GIVEN):.2f}, with shuffled poses {evidence.share(CHANCE):.2f}, "
        f"expected at least {_FIT_AT_LEAST:g}"
    )
    if evidence.nearness is not None and evidence.nearness < _NEARNESS:
        return Finding(
            "frames",
            f"the poses in {given.file} belong to other frames than the masks ({said}; cameras "
            "that are turned alike do not show the same objects): pair each pose with its picture",
        )
    return Finding(
        "unknown",
        f"masks and poses in {given.file} do not fit ({said}), and no known mistake explains it: "
        "are the poses those of these pictures, and exact to a few centimetres?",
    )


def _implausible(evidence: Evidence, given: Given) -> Finding | None:
    """Find an unusual direction, height or length, which masks alone do not determine."""
    axis = int(np.abs(evidence.tops).argmax())
    if abs(evidence.tops[axis]) > 0.5 and evidence.tops[1] <= 0.5:
        return Finding("up", of_up(axis, float(np.sign(evidence.tops[axis])), given))
    length_m = evidence.length_m if evidence.measured >= _SOME_LENGTHS else None
    for what, value, bounds in (
        ("the cameras stand", evidence.eye_m, _EYES_M),
        ("the objects are", length_m, _LENGTHS_M),
    ):
        if value is not None and not bounds[0] <= value <= bounds[1]:
            factor = _metres_per_unit(evidence) if given.posed else None
            verb = "above the floor" if bounds == _EYES_M else "long"
            sentence = of_unit(what, value, bounds, factor).replace(" m in", f" m {verb} in", 1)
            return Finding(("unit", factor), sentence)
    if evidence.floor_m is not None and abs(evidence.floor_m) > _FLOOR_M:
        side = "above" if evidence.floor_m > 0 else "below"
        cure = (
            "correct or leave out floor_m, or --floor-m (the floor is then estimated)"
            if given.posed
            else "is the floor at y = 0?"
        )
        return Finding(
            "floor",
            f"the lowest objects end {abs(evidence.floor_m):.2f} m {side} the floor: {cure}",
        )
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

    of: dict[str, list[Cause]] = {}
    for cause in evidence.sums:
        if "sorted" not in cause.detail:  # both orders are equal for few frames
            of.setdefault(cause.family, []).append(cause)
    yes: list[str] = []
    no: list[str] = []
    for name, causes in (
        ("matrices of another kind or with other axes", of.get("poses", [])),
        ("poses of other frames", [*of.get("order", []), CHANCE]),
        ("a principal point off by 30% of the picture",
         [cause for cause in of.get("center", []) if max(map(abs, cause.shift)) > 0.2]),
    ):  # fmt: skip
        (yes if excluded(causes) else no).append(name)
    focal = of.get("focal", [])
    for step in sorted({abs(step) for step in FOCAL_STEPS}):
        times = 2 ** (step / 6)
        beyond = [cause for cause in focal if abs(np.log2(cause.factor)) > (step - 0.5) / 6]
        if excluded(beyond):
            yes.append(f"focal lengths {times:.2g} times as long or as short")
            break
    else:
        no.append("wrong focal lengths")
    return yes, no
