"""Turns the agreement of ground truth and masks into sentences about a room or a folder."""

from collections.abc import Iterator, Sequence

import numpy as np

from data_prep.inspection.agreement import HELD_AT_LEAST, IOU_AT_LEAST, Agreement, Comparison
from data_prep.inspection.bodies import KINDS
from data_prep.inspection.truth_causes import Bodies, Trial, likely_cause, out_of_order
from sceneprior.core.shards import RoomViews

ROOM_MASKS = 5
"""Minimum number of masks for a statement about a room."""
_OUTLIER = 0.5
"""Share of agreeing masks below which a view or object is reported, in a room that agrees as a
whole."""


def disagreement(
    agreement: Agreement,
    kind: str,
    trials: Sequence[dict[str, Trial]],
    share: float = 1.0,
    least: int = 1,
) -> str:
    """State that masks and 3D objects disagree, and name the likely cause; no final full stop."""
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
    return f"{text}: {likely_cause(trials, kind, share, least)}"


def outliers(bodies: Bodies, views: RoomViews, seen: Comparison) -> Iterator[str]:
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
