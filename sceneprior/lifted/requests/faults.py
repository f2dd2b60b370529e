"""What a person would fault at one look in a requested room, beyond the checks of the metrics."""

from collections.abc import Iterator, Sequence

import numpy as np
import shapely

from sceneprior.core.arrangements import (
    BEDS,
    NIGHTSTANDS,
    OPENED,
    SCREENS,
    SEATS,
    Piece,
    end_of_bed,
    findings,
    floor_beside,
    heads,
    is_free,
    opposite,
    rows_of,
    seats_at,
)

Fault = tuple[str, tuple[int, ...]]
"""Its name, and the rows of the pieces that it is about."""
ALIKE = 0.15
"""Share by which the extents of a bed's nightstands or of a table's chairs may differ."""
PATH_M = 0.6
"""Width of a path."""
PULLED_M = 0.35
"""Depth of the floor behind a chair at a table, onto which it is pulled out."""
LEGS_M = 0.3
"""Depth of the floor before a sofa that must be free."""
SEEN_M, VIEW_M = 0.5, 0.3
"""Height from which pieces hide a screen, and width of the view of it from a seat."""
CHECKS = (
    "pairs_at_bed", "chairs_at_tables", "chairs_turned", "screens_seen", "fronts_free",
    "backs_covered",
)  # fmt: skip
"""Checks of function that places should not fail."""


def faults_of(pieces: Sequence[Piece], floor: shapely.Polygon) -> set[Fault]:
    """The faults of a partly furnished room, but for those that pieces to come may mend."""
    found = findings(pieces, floor)
    failed = {
        (check, each.rows) for check in CHECKS for each in found.get(check, []) if not each.holds
    }
    return failed | {*_of_bed(pieces), *_of_chairs(pieces, floor), *_of_sofas(pieces, floor)}


def places_to_reach(pieces: Sequence[Piece]) -> dict[Fault, shapely.Polygon]:
    """The strips of floor to which paths should lead, by the fault if none does."""
    strips: dict[Fault, shapely.Polygon] = {
        ("path to the front", (row,)): pieces[row].before(PATH_M)
        for row in rows_of(pieces, OPENED)
        if pieces[row].front is not None and pieces[row].standing
    }
    for bed, row, place in _bedsides(pieces):
        if place is not None and place[0] in heads(bed):
            strips["path to the bedside", (row,)] = floor_beside(bed, place[1], PATH_M)
    return strips


def _bedsides(
    pieces: Sequence[Piece],
) -> Iterator[tuple[Piece, int, tuple[float, float] | None]]:
    """The only bed, and each nightstand with its place there (`end_of_bed`)."""
    beds = rows_of(pieces, BEDS)
    for row in rows_of(pieces, NIGHTSTANDS) if len(beds) == 1 else []:
        yield pieces[beds[0]], row, end_of_bed(pieces[beds[0]], pieces[row])


def _of_bed(pieces: Sequence[Piece]) -> Iterator[Fault]:
    """Nightstands that differ, stand at the foot, or are turned otherwise than the only bed."""
    for bed, row, place in _bedsides(pieces):
        if place is None or place[0] not in heads(bed):
            yield "beside the head", (row,)
        elif _turned_apart(bed, pieces[row]):
            yield "turned as the bed", (row,)
    stands = rows_of(pieces, NIGHTSTANDS)
    one_bed = len(rows_of(pieces, BEDS)) == 1
    if one_bed and len(stands) == 2 and not _alike(*(pieces[row] for row in stands)):
        yield "as large as the other", tuple(stands)


def _of_chairs(pieces: Sequence[Piece], floor: shapely.Polygon) -> Iterator[Fault]:
    """Chairs at a table that cannot be pulled out, or differ from its other chairs."""
    at = seats_at(pieces)
    for chair, table in at.items():
        others = [piece for row, piece in enumerate(pieces) if row != chair and piece.standing]
        if pieces[chair].front is not None and not is_free(
            pieces[chair].before(-PULLED_M), others, floor
        ):
            yield "room to pull it out", (chair,)
        first = min(row for row, own in at.items() if own == table)
        if not _alike(pieces[first], pieces[chair]):
            yield "as large as the other", (first, chair)


def _of_sofas(pieces: Sequence[Piece], floor: shapely.Polygon) -> Iterator[Fault]:
    """Sofas without room for legs, and screens that other pieces hide from the seats opposite."""
    others = [piece for piece in pieces if piece.standing]
    for row in rows_of(pieces, ("sofa",)):
        sofa = pieces[row]
        blocking = [other for other in others if other is not sofa]
        if sofa.front is not None and not is_free(sofa.before(LEGS_M), blocking, floor):
            yield "room for legs", (row,)
    seats, screens = (
        [row for row in rows_of(pieces, labels) if pieces[row].front is not None]
        for labels in (SEATS, SCREENS)
    )
    high = [piece for piece in others if piece.size_m[1] > SEEN_M]
    for screen in screens:
        views = [
            shapely.LineString([pieces[screen].center, pieces[seat].center]).buffer(VIEW_M / 2)
            for seat in seats
            if opposite(pieces[screen], pieces[seat])
        ]
        hiding = [piece.place for piece in high if piece.label not in (*SEATS, *SCREENS)]
        if views and all(any(place.intersects(view) for place in hiding) for view in views):
            yield "a view of the screen", (screen,)


def _alike(one: Piece, other: Piece) -> bool:
    """True if no extent of a piece exceeds that of the other by more than `ALIKE`."""
    ratios = np.array(one.size_m) / np.array(other.size_m)
    return bool(np.abs(np.log(ratios)).max() <= np.log(1 + ALIKE))


def _turned_apart(one: Piece, other: Piece) -> bool:
    """True if the fronts of two pieces are known and point in different directions."""
    if one.front is None or other.front is None:
        return False
    return bool(one.front @ other.front < 0.5)
