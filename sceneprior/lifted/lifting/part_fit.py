"""Greedy search for the few parts that explain the rays of one prototype.

Each step tries all changes on a subset of the rays, and the best of them on all rays. The best
change is kept; the search ends when no change lowers the loss (`part_loss.py`).
"""

import itertools
from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Int
from scipy import ndimage

from sceneprior.core.parts import (
    ACROSS_X,
    ACROSS_Z,
    BOWL,
    BOX,
    CYLINDER,
    DOME,
    ELLIPSOID,
    MOST_PARTS,
    Parts,
)
from sceneprior.lifted.lifting.lifted import RayPool
from sceneprior.lifted.lifting.outlines import outline_of
from sceneprior.lifted.lifting.part_loss import Change, Guess, RayFit
from sceneprior.lifted.lifting.part_prices import LEVELS

CURVED = (CYLINDER, ELLIPSOID, DOME, BOWL)
LEAST_GAIN = 1e-4
"""Smallest decrease of the loss for which a change is kept."""
PLACES = (0.25, 0.5, 0.75)
"""Positions at which parts are split, as shares of their length."""
SHORTEST = 4
"""Length in levels below which a part is not split."""
SLIT, SLIT_LOSS = 8, 0.002
"""Width in levels up to which a slit is closed, and the increase of the loss up to which it is."""
PIECES = 4
"""Number of uncovered pieces of the hull, the largest first, in which new parts are tried."""
SCREENED, FINALISTS = 768, 6
"""Number of rays on which all changes are tried, and number of changes, the best on these, that are
then tried on all rays."""


def fit_parts(
    rays: RayPool, hull: Bool[np.ndarray, "x y z"], margin: float, hangs: bool = False
) -> Parts:
    """Fit parts to the rays of one object, or of several similar objects.

    Args:
        rays: Rays in random order, in the frame that spans [-1, 1], which is `margin` boxes wide.
            Rays that miss the outline are ignored. Without any others, the box is the only part.
        hull: Visual hull on a grid of the same frame. It gives the outline and shows where parts
            may be missing.
        hangs: True for an object that is held from above; others stand.
    """
    cells = len(hull)
    beyond = round((1 - 1 / margin) / 2 * cells)
    hull = hull[(slice(beyond, cells - beyond),) * 3]
    outline = outline_of(hull)
    every = RayFit(rays, margin, outline, hangs)
    guess = every.guess(np.array([BOX]), np.array([0]), np.array([[[0, LEVELS]] * 3]))
    if not len(every.hits):
        return guess.parts(outline)
    some = RayFit(RayPool(*(part[:SCREENED] for part in rays)), margin, outline, hangs)
    while better := _one_more(every, some, guess, hull) or _one_more(every, every, guess, hull):
        guess = better
    return _needed(every, _whole(every, _closed(every, guess))).parts(outline)


def _one_more(
    every: RayFit, some: RayFit, guess: Guess, hull: Bool[np.ndarray, "x y z"]
) -> Guess | None:
    """The guess after the change that lowers the loss most; None if no change lowers it."""
    rough = some.guess(*guess[:3])
    tried = []
    # A first part is not curved unless all else fails, or chairs would begin as bowls.
    curved = len(guess.kinds) > 1 or some is every
    for change in _changes(guess, hull, curved, every.hangs):
        trial = some.changed(rough, change)
        if all(
            kind == BOX for kind, _, _ in change.values()
        ):  # curved parts take ten times as long
            trial = some.settled(trial, change, 1)
        parts = zip(trial.kinds.tolist(), trial.mirrored.tolist(), trial.ends, strict=True)
        settled = {row: part for row, part in enumerate(parts) if row in change}
        tried.append((some.loss(trial), settled))
    best, least = None, every.loss(guess) - LEAST_GAIN
    for _, change in sorted(tried, key=lambda each: each[0])[:FINALISTS]:
        trial = every.settled(every.changed(guess, change), change, 2)
        if (loss := every.loss(trial)) < least:
            best, least = trial, loss
    return best and every.settled(best, range(len(best.kinds)), 2)


def _changes(
    guess: Guess, hull: Bool[np.ndarray, "x y z"], curved: bool, hangs: bool
) -> Iterator[Change]:
    """Changes to try: a different kind for a part; a part
    mirrored with its own or a quarter of its width; a part split in two, each fitted to the hull; a
    part extended to the floor; supports of a part; a new part around an uncovered piece of
    the hull."""
    new = len(guess.kinds)
    room = new < MOST_PARTS
    for row in range(new):
        across, ends = int(guess.mirrored[row]), guess.ends[row]
        if curved:
            yield from ({row: (kind, across, ends)} for kind in CURVED if kind != guess.kinds[row])
        for axis, bit in enumerate((ACROSS_X, 0, ACROSS_Z)):
            low, high = ends[axis]
            if high - low < SHORTEST:
                continue
            single = bit and not across & bit
            if single:
                narrow = ends.copy()
                narrow[axis, 1] = low + (high - low) // 4
                yield {row: (BOX, across | bit, narrow)}
                yield {row: (int(guess.kinds[row]), across | bit, ends)}
            for share in PLACES if room else ():
                one, other = ends.copy(), ends.copy()
                one[axis, 1] = other[axis, 0] = low + round(share * (high - low))
                one, other = _extents_of(hull, one), _extents_of(hull, other)
                yield {row: (BOX, across, one), new: (BOX, across, other)}
                if single and share < 0.5:
                    yield {row: (BOX, across | bit, one), new: (BOX, across, other)}
        if ends[1, 0] > 0:
            yield _lowered(guess, row)
        if room and (LEVELS - ends[1, 1] if hangs else ends[1, 0]) >= SHORTEST:
            yield from ({new: (BOX, *each)} for each in _supports(ends, hangs))
    labels, pieces = ndimage.label(hull & ~_cells_in(guess, len(hull)))
    if not pieces or not room:
        return
    boxes = ndimage.find_objects(labels)
    for piece in np.argsort(-np.bincount(labels.ravel())[1:], kind="stable")[:PIECES]:
        own = np.array([[side.start, side.stop] for side in boxes[piece]]) * LEVELS // len(hull)
        for across in (0, ACROSS_X, ACROSS_Z, ACROSS_X | ACROSS_Z):
            yield {new: (BOX, across, own)}


def _supports(
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
            leg[axis, 1] = min(leg[axis, 0] + SHORTEST, ends[axis, 1])
        yield across, leg


def _with_image(ends: Int[np.ndarray, "2"]) -> tuple[int, int]:
    """Ends along one axis of the interval around a part and its mirror image."""
    far = int(max(ends[1], LEVELS - ends[0]))
    return LEVELS - far, far


def _extents_of(
    hull: Bool[np.ndarray, "x y z"], ends: Int[np.ndarray, "3 2"]
) -> Int[np.ndarray, "3 2"]:
    """The bounding box of the hull's cells in a box; the box itself if it has none."""
    cells = len(hull)
    first, last = ends[:, 0] * cells // LEVELS, -(-ends[:, 1] * cells // LEVELS)
    inner = hull[first[0] : last[0], first[1] : last[1], first[2] : last[2]]
    if not inner.any():
        return ends
    found = ends.copy()
    for axis in range(3):
        filled = first[axis] + np.flatnonzero(inner.any(axis=tuple({0, 1, 2} - {axis})))
        found[axis, 0] = max(ends[axis, 0], filled[0] * LEVELS // cells)
        found[axis, 1] = min(ends[axis, 1], -(-(filled[-1] + 1) * LEVELS // cells))
    return found


def _cells_in(guess: Guess, cells: int) -> Bool[np.ndarray, "x y z"]:
    """True for cells, of a grid over the object's box, in the box of some part."""
    found = np.zeros((cells,) * 3, bool)
    for _, ends in guess.parts().solids():
        first, last = np.rint((ends.T + 0.5) * cells).astype(int)
        found[first[0] : last[0], first[1] : last[1], first[2] : last[2]] = True
    return found


def _needed(every: RayFit, guess: Guess) -> Guess:
    """The guess without the parts whose removal lowers the loss and breaks nothing."""
    row = 0
    while row < len(guess.kinds) > 1:
        trial = every.without(guess, row)
        if _faults(every, trial) <= _faults(every, guess) and every.loss(trial) < every.loss(guess):
            guess, row = trial, 0
        else:
            row += 1
    return guess


def _closed(every: RayFit, guess: Guess) -> Guess:
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


def _whole(every: RayFit, guess: Guess) -> Guess:
    """The guess as one piece that reaches the floor or, if it hangs, the ceiling, whatever that
    costs. Masks often miss thin cords and legs, but nothing floats. Each step adds a bar or
    supports, or removes a part; the cheapest step that mends something is taken."""
    while faults := _faults(every, guess):
        new = len(guess.kinds)
        trials = [every.without(guess, row) for row in range(new) if new > 1]
        changes = _mends(guess, every.hangs) if new < MOST_PARTS else ()
        trials += [every.changed(guess, change) for change in changes]
        mended = [each for each in trials if _faults(every, each) < faults]
        if not mended:
            break
        guess = min(mended, key=every.loss)
    return guess


def _mends(guess: Guess, hangs: bool) -> Iterator[Change]:
    """Bars and supports, and for an object that stands also parts extended to the floor."""
    new = len(guess.kinds)
    yield from ({new: (BOX, *bar)} for bar in _bars(guess, hangs))
    for row, ends in enumerate(guess.ends):
        if ends[1, 1] < LEVELS if hangs else ends[1, 0] > 0:
            yield from ({new: (BOX, *each)} for each in _supports(ends, hangs))
            if not hangs:
                yield _lowered(guess, row)


def _lowered(guess: Guess, row: int) -> Change:
    """The change that extends a part to the floor."""
    down = guess.ends[row].copy()
    down[1, 0] = 0
    return {row: (int(guess.kinds[row]), int(guess.mirrored[row]), down)}


def _faults(every: RayFit, guess: Guess) -> int:
    """Number of pieces beyond one, and one more for a gap to the floor or the ceiling."""
    gap, pieces = every.gap_and_pieces(guess)
    return pieces - 1 + (gap > 0)


def _bars(guess: Guess, hangs: bool) -> Iterator[tuple[int, Int[np.ndarray, "3 2"]]]:
    """Boxes that connect each part to each other part and, for an object that hangs, to the
    ceiling: as wide as the overlap of the two, and two levels wide. Each comes with its mirroring.
    None stands on the floor: an object on a thin post would tip over."""
    ceiling = np.array([[0, LEVELS]] * 3)
    ceiling[1] = LEVELS
    both = ACROSS_X | ACROSS_Z
    ends = list(zip(guess.mirrored.tolist(), guess.ends, strict=True))
    for across, own in ends.copy():
        whole = own.copy()  # with the mirror images
        for bit, axis in ((ACROSS_X, 0), (ACROSS_Z, 2)):
            if across & bit:
                whole[axis] = _with_image(own[axis])
        ends += [(0, whole)] if across else []
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
