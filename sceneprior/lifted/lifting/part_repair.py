"""Mends the parts of a prototype: no slits, one piece, and nothing that floats or tips over."""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Int

from sceneprior.core.parts import ACROSS_X, ACROSS_Z, BOX, MOST_PARTS
from sceneprior.lifted.lifting.part_loss import Change, Guess, RayFit
from sceneprior.lifted.lifting.part_regularizers import LEVELS

SUPPORT = 4
"""Width in levels of a leg or a panel."""
SLIT, SLIT_LOSS = 8, 0.002
"""Width in levels up to which a slit is closed, and the increase of the loss up to which it is."""


def closed(every: RayFit, guess: Guess) -> Guess:
    """The guess without narrow slits between a part and its mirror image, unless rays show them."""
    for row in range(len(guess.kinds)):
        for axis, bit in ((0, ACROSS_X), (2, ACROSS_Z)):
            low, high = guess.ends[row, axis]
            slit = max(LEVELS - 2 * high, 2 * low - LEVELS)
            if guess.mirrored[row] & bit and 0 < slit <= SLIT:
                joined = guess.ends[row].copy()
                joined[axis] = _with_image(joined[axis])
                across = int(guess.mirrored[row]) & ~bit
                trial = every.changed(guess, {row: (int(guess.kinds[row]), across, joined)})
                if every.loss(trial) < every.loss(guess) + SLIT_LOSS:
                    guess = trial
    return guess


def whole(every: RayFit, guess: Guess) -> Guess:
    """The guess as one piece that stands on the floor without tipping over or, if it hangs, reaches
    the ceiling, whatever that costs. Masks often miss thin cords and legs, but nothing floats. Each
    step adds a bar or supports, or mirrors or removes a part; the cheapest step that mends
    something is taken."""
    while faults := faults_of(every, guess):
        new = len(guess.kinds)
        trials = [every.without(guess, row) for row in range(new) if new > 1]
        changes = _mends(guess, every.hangs) if new < MOST_PARTS else ()
        trials += [every.changed(guess, change) for change in changes]
        mended = [each for each in trials if faults_of(every, each) < faults]
        if not mended:
            break
        guess = min(mended, key=every.loss)
    return guess


def faults_of(every: RayFit, guess: Guess) -> int:
    """Number of pieces beyond one, one more for a gap to the floor or the ceiling, and one more for
    an overhang."""
    gap, pieces = every.gap_and_pieces(guess)
    return abs(pieces - 1) + (gap > 0) + (every.overhang(guess) > 0)


def _mends(guess: Guess, hangs: bool) -> Iterator[Change]:
    """Bars and supports, and for an object that stands also parts extended to the floor, and
    mirrored feet."""
    new = len(guess.kinds)
    yield from ({new: (BOX, *bar)} for bar in _bars(guess, hangs))
    for row, ends in enumerate(guess.ends):
        if ends[1, 1] < LEVELS if hangs else ends[1, 0] > 0:
            yield from ({new: (BOX, *each)} for each in supports(ends, hangs))
            if not hangs:
                yield lowered(guess, row)
        elif not hangs:
            kind, across = int(guess.kinds[row]), int(guess.mirrored[row])
            yield from ({row: (kind, across | bit, ends)} for bit in (ACROSS_X, ACROSS_Z))


def _bars(guess: Guess, hangs: bool) -> Iterator[tuple[int, Int[np.ndarray, "3 2"]]]:
    """Boxes that connect each part to each other part and, for an object that hangs, to the
    ceiling: as wide as the overlap of the two, and two levels wide. Each comes with its mirroring.
    None stands on the floor: an object on a thin post would tip over."""
    ceiling = np.array([[0, LEVELS]] * 3)
    ceiling[1] = LEVELS
    both = ACROSS_X | ACROSS_Z
    ends = list(zip(guess.mirrored.tolist(), guess.ends, strict=True))
    for across, own in ends.copy():
        both_sides = own.copy()  # with the mirror images
        for bit, axis in ((ACROSS_X, 0), (ACROSS_Z, 2)):
            if across & bit:
                both_sides[axis] = _with_image(own[axis])
        ends += [(0, both_sides)] if across else []
    targets = [*ends, (both, ceiling)] if hangs else ends
    for (one, here), (other, there) in itertools.product(ends, targets):
        last_low = np.maximum(here[:, 0], there[:, 0])
        first_high = np.minimum(here[:, 1], there[:, 1])
        between = np.sort([last_low, first_high], axis=0)  # the gap, or the overlap
        narrow = between.copy()
        overlaps = last_low <= first_high
        middle = between.sum(axis=0)[overlaps] // 2
        narrow[:, overlaps] = middle - 1, middle + 1
        for low, high in (between, narrow):
            bar = np.stack([low, np.maximum(high, low + 1)], axis=1).clip(0, LEVELS)
            if (bar[:, 0] < bar[:, 1]).all():
                yield one & other, bar


def supports(
    ends: Int[np.ndarray, "3 2"], hangs: bool
) -> Iterator[tuple[int, Int[np.ndarray, "3 2"]]]:
    """Supports of a part, each as mirroring and ends: four legs, two side panels, or a front and a
    back panel on the floor; for an object that hangs, a cord from the middle to the ceiling."""
    if hangs:
        cord = ends.copy()
        middle = ends.sum(axis=1) // 2
        cord[::2] = np.stack([middle - 1, middle + 1], axis=1)[::2]
        cord[1] = ends[1, 1], LEVELS
        yield 0, cord
        return
    under = ends.copy()
    under[1] = 0, ends[1, 0]
    for axes, across in (((0, 2), ACROSS_X | ACROSS_Z), ((0,), ACROSS_X), ((2,), ACROSS_Z)):
        leg = under.copy()
        for axis in axes:
            leg[axis, 1] = min(leg[axis, 0] + SUPPORT, ends[axis, 1])
        yield across, leg


def lowered(guess: Guess, row: int) -> Change:
    """The change that extends a part to the floor."""
    down = guess.ends[row].copy()
    down[1, 0] = 0
    return {row: (int(guess.kinds[row]), int(guess.mirrored[row]), down)}


def _with_image(ends: Int[np.ndarray, "2"]) -> tuple[int, int]:
    """Ends along one axis of the interval around a part and its mirror image."""
    far = int(max(ends[1], LEVELS - ends[0]))
    return LEVELS - far, far
