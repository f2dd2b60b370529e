"""Faults of a requested room that a person notices at once, those of the metrics included."""

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
"""A fault: its name, and the rows of the pieces that it is about."""
ALIKE = 0.15
"""Share by which the extents of a bed's nightstands or of a table's chairs may differ."""
PATH_M = 0.6
"""Width of a path."""
PULLED_M = 0.4
"""Distance from its table to which a chair must have room to be pulled out."""
LEGS_M = 0.2
"""Depth of the floor before a sofa that must be free."""
SEEN_M, VIEW_M = 0.5, 0.3
"""Height from which pieces hide a screen, and width of the view of it from a seat."""
LOW = ("coffee_table", "stool")
"""Classes that stand before seats and screens."""
CHECKS = (
    "pairs_at_bed", "chairs_at_tables", "chairs_turned", "screens_seen", "fronts_free",
    "backs_covered",
)  # fmt: skip
"""Checks of function that places should not fail."""
COMFORT = ("room to pull it out", "like the other chairs", "room for legs", "a view of the screen")
"""Faults that a room may have if it would otherwise be furnished again and again."""


def faults_of(pieces: Sequence[Piece], floor: shapely.Polygon) -> set[Fault]:
    """The faults of a partly furnished room; those that later pieces may mend are left out."""
    found = findings(pieces, floor)
    failed = {
        (check, each.rows) for check in CHECKS for each in found.get(check, []) if not each.holds
    }
    return failed | {
        *_of_bed(pieces),
        *_of_chairs(pieces, floor),
        *_of_sofas(pieces, floor),
        *_of_screens(pieces),
    }


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
    for row, table in at.items():
        chair = pieces[row]
        more_m = PULLED_M - chair.place.distance(pieces[table].place)
        if chair.front is not None and chair.faces(pieces[table]) and more_m > 0:
            others = [other for other in pieces if other is not chair and other.standing]
            if not is_free(chair.before(-more_m), others, floor):
                yield "room to pull it out", (row,)
        first = next(own for own in at if at[own] == table and pieces[own].label == chair.label)
        if not _alike(pieces[first], chair):
            yield "like the other chairs", (first, row)


def _of_sofas(pieces: Sequence[Piece], floor: shapely.Polygon) -> Iterator[Fault]:
    """Sofas without room for legs."""
    for row in rows_of(pieces, ("sofa",)):
        sofa = pieces[row]
        others = [other for other in pieces if other is not sofa and other.standing]
        blocking = [other for other in others if other.label != "stool"]
        if sofa.front is not None and not is_free(sofa.before(LEGS_M), blocking, floor):
            yield "room for legs", (row,)


def _of_screens(pieces: Sequence[Piece]) -> Iterator[Fault]:
    """Screens that other pieces hide from all seats opposite."""
    seats, screens = (
        [row for row in rows_of(pieces, labels) if pieces[row].front is not None]
        for labels in (SEATS, SCREENS)
    )
    high = [
        piece
        for piece in pieces
        if piece.standing and piece.size_m[1] > SEEN_M
        and piece.label not in (*SEATS, *SCREENS, *LOW)
    ]  # fmt: skip
    for row in screens:
        screen = pieces[row]
        hiding = [piece.place for piece in high if not piece.place.intersects(screen.place)]
        views = [
            shapely.LineString([screen.center, pieces[seat].center]).buffer(VIEW_M / 2)
            for seat in seats
            if opposite(screen, pieces[seat])
        ]
        if views and all(any(place.intersects(view) for place in hiding) for view in views):
            yield "a view of the screen", (row,)


def _alike(one: Piece, other: Piece) -> bool:
    """True if no extent of a piece exceeds that of the other by more than `ALIKE`."""
    ratios = np.array(one.size_m) / np.array(other.size_m)
    return bool(np.abs(np.log(ratios)).max() <= np.log(1 + ALIKE))


def _turned_apart(one: Piece, other: Piece) -> bool:
    """True if the fronts of two pieces are known and point in different directions."""
    if one.front is None or other.front is None:
        return False
    return bool(one.front @ other.front < 0.5)
