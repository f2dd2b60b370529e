"""Turns the agreement of 3D objects and masks into sentences about a room or a folder."""

from collections.abc import Iterator, Sequence

import numpy as np

from data_prep.inspection.agreement import (
    HELD_AT_LEAST,
    IOU_AT_LEAST,
    ROOM_SHARE,
    Agreement,
    Comparison,
)
from data_prep.inspection.bodies import KINDS, Body
from data_prep.inspection.causes import Trial, chance_of, likely_cause, out_of_order
from sceneprior.core.shards import RoomViews

_ROOM_MASKS = 5
"""Minimum number of masks for a statement about a room."""
_OUTLIER = 0.5
"""Share of agreeing masks below which a view or object is reported, in a room that agrees as a
whole."""
_CAMERA_HEIGHTS_M = 0.2, 4.0
_OBJECT_SIZES_M = 0.15, 6.0
"""Plausible ranges of a room's median camera height and median object length."""

Trials = Sequence[dict[str, Trial]]


def disagreement(
    agreement: Agreement, kind: str, trials: Trials, share: float = 1.0, least: int = 1
) -> str:
    """Say that masks and 3D objects disagree, and name the likely cause; without the full stop."""
    tally = agreement.of(kind)
    text = (
        f"{tally.share:.0%} of {tally.masks} masks lie within the projected {KINDS[kind]}, "
        f"expected at least {share * HELD_AT_LEAST[kind]:.0%}"
    )
    if tally.whole:
        text += (
            f", and those of unoccluded objects overlap with a mean 2D IoU of "
            f"{tally.mean_iou:.2f}, expected at least {share * IOU_AT_LEAST[kind]:.2f}"
        )
    chance = chance_of(trials, kind)
    if tally.share <= chance + 0.1:
        text += f"; no better than randomly shuffled cameras ({chance:.0%})"
    return f"{text}: {likely_cause(trials, kind, share, least)}"


def room_problems(
    bodies: Sequence[Body | None], views: RoomViews, seen: Comparison, trials: Trials
) -> Iterator[str]:
    """Report the problems of a room as sentences without its name.

    For boxes found from the masks, units are checked instead of single views and objects.
    """
    agreement = seen.agreement
    failing = agreement.failing(ROOM_SHARE, _ROOM_MASKS)
    for kind in failing:
        yield disagreement(agreement, kind, trials, ROOM_SHARE, _ROOM_MASKS)
    if "found" in seen.kinds:
        yield from _unit_problems(bodies, views)
    elif not failing:
        yield from _outliers(bodies, views, seen)


def _outliers(bodies: Sequence[Body | None], views: RoomViews, seen: Comparison) -> Iterator[str]:
    """Report views and objects that disagree in a room that agrees as a whole."""
    count, held = seen.judged.sum(axis=1), (seen.judged & seen.held).sum(axis=1)
    wrong = np.flatnonzero((count >= 2) & (held < _OUTLIER * count))
    if len(wrong):
        order, _ = out_of_order(bodies, views)
        others = [int(order[view]) for view in wrong]
        why = "are their poses wrong?"
        if set(others) & set(wrong.tolist()) and (order[wrong] != wrong).all():
            pairs = (f"{view} (by {other})" for view, other in zip(wrong, others, strict=True))
            why = f"those of other frames would fit: {', '.join(pairs)}"
        yield (
            f"{held[wrong].sum()} of the {count[wrong].sum()} masks of views "
            f"{_listed(wrong)} lie within their projections, in other views nearly all do: {why}"
        )
    seen_in = seen.judged.sum(axis=0)
    lost = (seen.judged & ~seen.held).sum(axis=0)
    for k in np.flatnonzero((seen_in >= 3) & (lost > _OUTLIER * seen_in)):
        if not len(wrong):
            yield (
                f"object {k} is not where its ground truth has it: {lost[k]} of its {seen_in[k]} "
                "masks reach beyond its projection, unlike those of other objects"
            )


def _listed(numbers: np.ndarray) -> str:
    shown = ", ".join(str(number) for number in numbers[:6])
    return shown + (f" and {len(numbers) - 6} more" if len(numbers) > 6 else "")


def _unit_problems(bodies: Sequence[Body | None], views: RoomViews) -> Iterator[str]:
    """Report implausible camera heights and object sizes.

    Masks and poses alone do not determine the scale, but floor and furniture have typical sizes.
    """
    poses = views.world_to_camera.astype(np.float64)
    eyes = -(poses[:, :3, :3].transpose(0, 2, 1) @ poses[:, :3, 3:])[..., 0]
    height = float(np.median(eyes[:, 1]))
    sizes = [np.ptp(body.hull.points_m, axis=0).max() for body in bodies if body is not None]
    for value, (least, most), what in (
        (height, _CAMERA_HEIGHTS_M, "its cameras stand {0} m above the floor"),
        (float(np.median(sizes)), _OBJECT_SIZES_M, "its objects are {0} m long"),
    ):
        if not least <= value <= most:
            yield (
                f"{what.format(f'{value:.3g}')} in the median, expected {least:g} to {most:g}: are "
                "the poses in metres, and the floor where it should be?"
            )
