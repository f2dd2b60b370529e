"""Looks along a path between rooms: where on the path each look is shown, and its parts."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from sceneprior.core.parts import SQUARE, Parts, Stretch
from sceneprior.lifted.prototypes import pose_rotation, turn_of

HOLD = 0.125
"""Minimum share of the path that a look between two others must hold to be shown. A smaller value
follows the decoder more closely, but objects change faster."""


class Appearance(NamedTuple):
    """Looks shown during one appearance of a prediction on a path, and the place of each."""

    places: Float[np.ndarray, " shown"]
    looks: Int[np.ndarray, " shown"]

    def apart(self, place: float) -> float:
        """Distance of a place on the path from this appearance."""
        return float(np.abs(place - np.clip(place, *self.places[[0, -1]])))

    def at(self, place: float) -> tuple[int, int, float]:
        """The two looks between which the shape lies, and the weight of the second, in [0, 1)."""
        after = int(np.searchsorted(self.places, place, side="right"))
        look, next_look = self.looks[max(after - 1, 0)], self.looks[min(after, len(self.looks) - 1)]
        if after in (0, len(self.looks)) or look == next_look:
            return int(look), int(look), 0.0
        start, end = self.places[after - 1 : after + 1]
        return int(look), int(next_look), float((place - start) / (end - start))


def appearances_of(
    looks: Int[np.ndarray, " steps"], kept: Bool[np.ndarray, " steps"]
) -> list[Appearance]:
    """The looks that one prediction shows on a path, for each of its appearances.

    `looks` has the decoded look at equal steps from 0 to 1, and `kept` is true where the prediction
    is an object. The first and last look of an appearance are shown at its ends. A look between
    them that holds for at least `HOLD` is shown in the middle of the steps where it holds.
    """
    places = np.linspace(0, 1, len(looks))
    changes = np.flatnonzero(np.diff(np.where(kept, looks, -1))) + 1
    found = []
    for steps in np.split(np.arange(len(looks)), np.flatnonzero(np.diff(kept)) + 1):
        if not kept[steps[0]]:
            continue
        within = changes[(changes > steps[0]) & (changes <= steps[-1])] - steps[0]
        ends = places[steps[[0, -1]]]
        between = [
            (places[run[[0, -1]]].mean(), looks[run[0]])
            for run in np.split(steps, within)[1:-1]
            if len(run) >= HOLD * (len(looks) - 1)
        ]
        shown = [(ends[0], looks[steps[0]]), *between, (ends[1], looks[steps[-1]])]
        found.append(Appearance(*map(np.array, zip(*shown, strict=True))))
    return found


def posed_parts(parts: Parts, pose: int) -> Parts:
    """The parts of a prototype in a pose, with mirror images as separate parts."""
    across = pose_rotation(pose)
    kind, ends = zip(*parts.solids(), strict=True)
    outline = parts.outline
    if not np.array_equal(outline, SQUARE):
        outline = outline @ across[::2, ::2].T
        outline = outline[::-1] if turn_of(pose)[1] else outline  # stays counter-clockwise
    return Parts(
        np.array(kind), np.zeros(len(kind), np.int64), np.sort(across @ np.stack(ends)), outline
    )


def stretched_parts(parts: Parts, own: Stretch, new_size_m: Float[np.ndarray, "3"]) -> Parts:
    """Stretch parts, in the frame of the object's box, to a box of the extents `new_size_m`."""
    corners = parts.ends.transpose(0, 2, 1).reshape(-1, 3)
    points = np.concatenate([corners, np.insert(parts.outline, 1, 0.0, axis=1)])
    corners, outline = np.split(own.moved(points, new_size_m), [len(corners)])
    return parts._replace(
        ends=corners.reshape(-1, 2, 3).transpose(0, 2, 1),
        outline=parts.outline if np.array_equal(parts.outline, SQUARE) else outline[:, ::2],
    )
