"""Greedy search for the few parts that explain the rays of one prototype, and their repair.

Each step tries all changes on a subset of the rays, and the best of them on all rays. The best
change is kept; the search ends when no change lowers the loss (`part_loss.py`). Then slits are
closed, and the parts become one piece that neither floats nor tips over.
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
from sceneprior.lifted.lifting import RayPool
from sceneprior.lifted.lifting.part_loss import Change, Guess, Part, RayFit, outline_of
from sceneprior.lifted.lifting.part_rays import LEVELS

CURVED = (CYLINDER, ELLIPSOID, DOME, BOWL)
LEAST_GAIN = 1e-4
"""Smallest decrease of the loss for which a change is kept."""
PLACES = (0.25, 0.5, 0.75)
"""Positions at which parts are split, as shares of their length."""
SHORTEST = 4
"""Length in levels below which a part is not split."""
PIECES = 4
"""Number of uncovered pieces of the hull, the largest first, in which new parts are tried."""
SCREENED, FINALISTS = 768, 6
"""Number of rays on which all changes are tried, and number of changes, the best on these, that are
then tried on all rays."""
SUPPORT = 4
"""Width in levels of a leg or a panel."""
SLIT, SLIT_LOSS = 8, 0.002
"""Width in levels up to which a slit is closed, and the increase of the loss up to which it is."""


def fit_parts(rays: RayPool, hull: Bool[np.ndarray, "x y z"], margin: float, hangs: bool) -> Parts:
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
    return _needed(every, _repaired(every, _close_slits(every, guess))).parts(outline)


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
        # Curved parts would take ten times as long.
        if all(kind == BOX for kind, _, _ in change.values()):
            trial = some.refined(trial, change, 1)
        tried.append((some.loss(trial), {row: trial.part(row) for row in change}))
    best, least = None, every.loss(guess) - LEAST_GAIN
    for _, change in sorted(tried, key=lambda each: each[0])[:FINALISTS]:
        trial = every.refined(every.changed(guess, change), change, 2)
        if (loss := every.loss(trial)) < least:
            best, least = trial, loss
    return best and every.refined(best, range(len(best.kinds)), 2)


def _changes(
    guess: Guess, hull: Bool[np.ndarray, "x y z"], curved: bool, hangs: bool
) -> Iterator[Change]:
    """Changes to try: a different kind for a part; a part mirrored with its own or a quarter of its
    width; a part split in two, each fitted to the hull; a part extended to the floor; supports of a
    part; a new part around an uncovered piece of the hull."""
    new = len(guess.kinds)
    room = new < MOST_PARTS
    for row in range(new):
        own_kind, across, ends = guess.part(row)
        if curved:
            yield from ({row: (kind, across, ends)} for kind in CURVED if kind != own_kind)
        for axis, bit in enumerate((ACROSS_X, 0, ACROSS_Z)):
            low, high = ends[axis]
            if high - low < SHORTEST:
                continue
            single = bit and not across & bit
            if single:
                narrow = ends.copy()
                narrow[axis, 1] = low + (high - low) // 4
                yield {row: (BOX, across | bit, narrow)}
                yield {row: (own_kind, across | bit, ends)}
            for share in PLACES if room else ():
                one, other = ends.copy(), ends.copy()
                one[axis, 1] = other[axis, 0] = low + round(share * (high - low))
                one, other = _extents_of(hull, one), _extents_of(hull, other)
                yield {row: (BOX, across, one), new: (BOX, across, other)}
                if single and share < 0.5:
                    yield {row: (BOX, across | bit, one), new: (BOX, across, other)}
        if ends[1, 0] > 0:
            yield _extended_down(guess, row)
        if room and (LEVELS - ends[1, 1] if hangs else ends[1, 0]) >= SHORTEST:
            yield from ({new: each} for each in _supports(ends, hangs))
    uncovered, cells = hull.copy(), len(hull)
    for _, ends in guess.parts().solids():
        first, last = np.rint((ends.T + 0.5) * cells).astype(int)
        uncovered[first[0] : last[0], first[1] : last[1], first[2] : last[2]] = False
    labels, pieces = ndimage.label(uncovered)
    if not pieces or not room:
        return
    boxes = ndimage.find_objects(labels)
    for piece in np.argsort(-np.bincount(labels.ravel())[1:], kind="stable")[:PIECES]:
        own = np.array([[side.start, side.stop] for side in boxes[piece]]) * LEVELS // cells
        for across in (0, ACROSS_X, ACROSS_Z, ACROSS_X | ACROSS_Z):
            yield {new: (BOX, across, own)}


def _extents_of(
    hull: Bool[np.ndarray, "x y z"], ends: Int[np.ndarray, "3 2"]
) -> Int[np.ndarray, "3 2"]:
    """The bounding box of the hull's cells in a box; the box itself if it has none."""
    cells = len(hull)
    first, last = ends[:, 0] * cells // LEVELS, -(-ends[:, 1] * cells // LEVELS)
    block = hull[tuple(itertools.starmap(slice, zip(first, last, strict=True)))]
    # Asked thousands of times for a prototype: `argwhere` would take three times as long.
    found = [np.flatnonzero(block.any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    if not len(found[0]):
        return ends
    low = (first + [each[0] for each in found]) * LEVELS // cells
    high = -(-(first + [each[-1] + 1 for each in found]) * LEVELS // cells)
    return np.stack([np.maximum(ends[:, 0], low), np.minimum(ends[:, 1], high)], axis=1)


def _needed(every: RayFit, guess: Guess) -> Guess:
    """The guess without the parts whose removal lowers the loss and breaks nothing."""
    row = 0
    while row < len(guess.kinds) > 1:
        trial = every.without(guess, row)
        cheaper = every.loss(trial) < every.loss(guess)
        if cheaper and every.faults(trial) <= every.faults(guess):
            guess, row = trial, 0
        else:
            row += 1
    return guess


def _close_slits(every: RayFit, guess: Guess) -> Guess:
    """The guess without narrow slits between a part and its mirror image, unless rays show them."""
    for row in range(len(guess.kinds)):
        for axis, bit in ((0, ACROSS_X), (2, ACROSS_Z)):
            kind, across, ends = guess.part(row)
            low, high = ends[axis]
            slit = max(LEVELS - 2 * high, 2 * low - LEVELS)
            if across & bit and 0 < slit <= SLIT:
                joined = ends.copy()
                joined[axis] = _with_image(ends[axis])
                trial = every.changed(guess, {row: (kind, across & ~bit, joined)})
                if every.loss(trial) < every.loss(guess) + SLIT_LOSS:
                    guess = trial
    return guess


def _repaired(every: RayFit, guess: Guess) -> Guess:
    """The guess as one piece that stands on the floor without tipping over or, if it hangs, reaches
    the ceiling, whatever that costs. Masks often miss thin cords and legs, but nothing floats. Each
    step adds a bar or supports, or extends, mirrors or removes a part; the cheapest step that mends
    something is taken."""
    hangs = every.hangs
    while faults := every.faults(guess):
        new = len(guess.kinds)
        trials = [every.without(guess, row) for row in range(new) if new > 1]
        changes: list[Change] = [{new: bar} for bar in _bars(guess, hangs)]
        for row in range(new):
            kind, across, ends = guess.part(row)
            if ends[1, 1] < LEVELS if hangs else ends[1, 0] > 0:
                changes += [{new: each} for each in _supports(ends, hangs)]
                if not hangs:
                    changes.append(_extended_down(guess, row))
            elif not hangs:
                changes += [{row: (kind, across | bit, ends)} for bit in (ACROSS_X, ACROSS_Z)]
        trials += [every.changed(guess, change) for change in changes if new < MOST_PARTS]
        mended = [each for each in trials if every.faults(each) < faults]
        if not mended:
            break
        guess = min(mended, key=every.loss)
    return guess


def _bars(guess: Guess, hangs: bool) -> Iterator[Part]:
    """Boxes that connect each part to each other part and, for an object that hangs, to the
    ceiling: as wide as the overlap of the two, and two levels wide. None stands on the floor: an
    object on a thin post would tip over."""
    ceiling = np.array([[0, LEVELS]] * 3)
    ceiling[1] = LEVELS
    ends = list(zip(guess.mirrored.tolist(), guess.ends, strict=True))
    for across, own in ends.copy():
        both_sides = own.copy()  # with the mirror images
        for bit, axis in ((ACROSS_X, 0), (ACROSS_Z, 2)):
            if across & bit:
                both_sides[axis] = _with_image(own[axis])
        ends += [(0, both_sides)] if across else []
    targets = [*ends, (ACROSS_X | ACROSS_Z, ceiling)] if hangs else ends
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
                yield BOX, one & other, bar


def _supports(ends: Int[np.ndarray, "3 2"], hangs: bool) -> Iterator[Part]:
    """Supports of a part: four legs, two side panels, or a front and a back panel on the floor; for
    an object that hangs, a cord from the middle to the ceiling."""
    if hangs:
        cord = ends.copy()
        middle = ends.sum(axis=1) // 2
        cord[::2] = np.stack([middle - 1, middle + 1], axis=1)[::2]
        cord[1] = ends[1, 1], LEVELS
        yield BOX, 0, cord
        return
    under = ends.copy()
    under[1] = 0, ends[1, 0]
    for axes, across in (((0, 2), ACROSS_X | ACROSS_Z), ((0,), ACROSS_X), ((2,), ACROSS_Z)):
        leg = under.copy()
        for axis in axes:
            leg[axis, 1] = min(leg[axis, 0] + SUPPORT, ends[axis, 1])
        yield BOX, across, leg


def _extended_down(guess: Guess, row: int) -> Change:
    """The change that extends a part to the floor."""
    kind, across, ends = guess.part(row)
    down = ends.copy()
    down[1, 0] = 0
    return {row: (kind, across, down)}


def _with_image(ends: Int[np.ndarray, "2"]) -> tuple[int, int]:
    """Ends along one axis of the interval around a part and its mirror image."""
    far = int(max(ends[1], LEVELS - ends[0]))
    return LEVELS - far, far
