"""Function of furniture in a room, as a person checks it first: nightstands at a bed's end, chairs
at tables, fronts that face free floor, backs at a wall, televisions before sofas. Metrics, requests
and drawing share these definitions."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.colliders import HUNG, MOUNTED, MOUNTED_M
from sceneprior.core.scene import Scene, Turned

BEDS = ("bed", "double_bed", "kids_bed", "single_bed")
NIGHTSTANDS = ("nightstand", "night stand")
CHAIRS = ("chair", "dressing_chair")
TABLES = ("desk", "dressing_table", "table")
"""Classes of tables at which people sit on chairs."""
SEATS = ("sofa", *BEDS)
"""Classes from which people watch a screen."""
SCREENS = ("television", "tv_stand")
OPENED = (
    "cabinet",
    "children_cabinet",
    "desk",
    "dresser",
    "dressing_table",
    "tv_stand",
    "wardrobe",
)
"""Classes that are used from their front, with their back at a wall."""

BESIDE_M = 0.3
"""Largest distance of a nightstand from the bed's long side."""
AT_END_M = 0.5
"""Largest distance of a nightstand's centre from the bed's end, along the bed."""
LARGE_M, HIGH_M = 1.0, 0.6
"""Minimum length and height of a table that needs a chair; smaller ones stand at sofas."""
AT_TABLE_M = 0.1
"""Largest distance of a chair's footprint from the table's."""
TOWARDS_RAD = np.pi / 4
"""Largest angle between a front and what it faces."""
BEFORE_M = 0.6
"""Depth of the floor before a front that must be free."""
FREE_SHARE = 0.7
"""Share of a place, such as the floor before a front, that must be in the room and free."""
BACK_M = 0.1
"""Largest distance of a back from a wall or another piece."""
LOW_M = 0.15
"""Height below which a piece, such as a rug, blocks nothing."""


@dataclass(frozen=True, eq=False)
class Piece:
    """A piece of furniture on the floor plan."""

    label: str
    """Its class."""
    center: Float[np.ndarray, "2"]
    size_m: tuple[float, float, float]
    """Width across the front, height, and depth along the front."""
    front: Float[np.ndarray, "2"] | None
    """Unit vector (x, z) along its front; None if its yaw is unknown."""
    standing: bool
    """False for lamps and other pieces that hang."""

    @cached_property
    def place(self) -> shapely.Polygon:
        """Its footprint."""
        ahead = np.array([0.0, 1.0]) if self.front is None else self.front
        width, _, depth = self.size_m
        return _rectangle(self.center - ahead * depth / 2, ahead, width, depth)

    @classmethod
    def of(
        cls, label: str, center_m: Sequence[float], size_m: Sequence[float], box: Turned | None
    ) -> "Piece":
        """A piece with this centre (x, y, z), extents, and oriented box, if it is known."""
        own_m = size_m if box is None else box.size_m
        front = None if box is None else np.array([np.sin(box.yaw_rad), np.cos(box.yaw_rad)])
        center, bottom_m = np.array(center_m)[::2], center_m[1] - size_m[1] / 2
        hangs = label in HUNG or (label in MOUNTED and bottom_m > MOUNTED_M)
        return cls(label, center, (own_m[0], own_m[1], own_m[2]), front, not hangs)

    def before(self, depth_m: float) -> shapely.Polygon:
        """The rectangle before the front, as wide as the piece; behind it if the depth is
        negative. The yaw must be known."""
        assert self.front is not None
        edge = self.center + self.front * np.copysign(self.size_m[2] / 2, depth_m)
        return _rectangle(edge, self.front, self.size_m[0], depth_m)

    def back_gap_m(self, things: Iterable[shapely.Geometry]) -> float:
        """Distance of the middle of the back from the nearest of these things."""
        assert self.front is not None
        middle = shapely.Point(self.center - self.front * (self.size_m[2] / 2))
        return min(middle.distance(each) for each in things)

    def faces(self, other: "Piece") -> bool:
        """True if the other piece's centre lies within `TOWARDS_RAD` of the front."""
        assert self.front is not None
        away = other.center - self.center
        return bool(away @ self.front >= np.cos(TOWARDS_RAD) * np.linalg.norm(away) - 1e-9)


def _rectangle(
    middle: Float[np.ndarray, "2"], ahead: Float[np.ndarray, "2"], width_m: float, depth_m: float
) -> shapely.Polygon:
    across, far = np.array([ahead[1], -ahead[0]]) * width_m / 2, middle + ahead * depth_m
    return shapely.Polygon([middle - across, middle + across, far + across, far - across])


def pieces_of(scene: Scene) -> list[Piece]:
    """The furniture of a scene on its floor plan."""
    return [Piece.of(item.label, item.center_m, item.size_m, item.turned) for item in scene.objects]


class Finding(NamedTuple):
    """Outcome of a check of function."""

    rows: tuple[int, ...]
    """The pieces that it is about."""
    holds: bool


def findings(pieces: Sequence[Piece], floor: shapely.Geometry | None) -> dict[str, list[Finding]]:
    """Outcomes of all checks of function that apply to the pieces of a room, by check.

    Args:
        floor: None if it is unknown.
    """
    return {
        "pairs_at_bed": pairs_at_bed(pieces),
        **_seats(pieces),
        "screens_seen": _screens(pieces),
        **({} if floor is None else fronts(pieces, floor)),
    }


def rows_of(pieces: Sequence[Piece], labels: Sequence[str]) -> list[int]:
    """Rows of the pieces of some classes."""
    return [row for row, piece in enumerate(pieces) if piece.label in labels]


def end_of_bed(bed: Piece, other: Piece) -> tuple[float, float] | None:
    """The end of a bed at which a piece stands beside a long side, and this side, as signs along
    and across the bed; None if it does not stand there.

    The end -1 is the head if the front is known and at an end; see `heads`.
    """
    along, across, long_m, wide_m = _axes_of(bed)
    offset = other.center - bed.center
    end, side = float(np.sign(offset @ along)), float(np.sign(offset @ across))
    if abs(abs(offset @ along) - long_m / 2) > AT_END_M:
        return None
    middle = bed.center + side * across * wide_m / 2
    edge = shapely.LineString([middle - along * long_m / 2, middle + along * long_m / 2])
    return (end, side) if edge.distance(other.place) <= BESIDE_M else None


def _axes_of(bed: Piece) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Unit vectors along and across a bed, its length and its width."""
    ahead = np.array([0.0, 1.0]) if bed.front is None else bed.front
    width, _, depth = bed.size_m
    across = np.array([ahead[1], -ahead[0]])
    return (ahead, across, depth, width) if depth > width else (across, ahead, width, depth)


def heads(bed: Piece) -> tuple[float, ...]:
    """The ends of a bed that may be its head: both if its front is unknown or at a long side."""
    known = bed.front is not None and bed.size_m[2] > bed.size_m[0]
    return (-1.0,) if known else (-1.0, 1.0)


def squares_beside(bed: Piece, size_m: float) -> dict[tuple[float, float], shapely.Polygon]:
    """Squares of floor beside the long sides of a bed, at each end that may be its head, by end and
    side (`end_of_bed`)."""
    along, across, long_m, wide_m = _axes_of(bed)
    found = {}
    for end in heads(bed):
        for side in (-1.0, 1.0):
            middle = bed.center + along * end * long_m / 2 + across * side * (wide_m + size_m) / 2
            found[end, side] = _rectangle(middle, -along * end, size_m, size_m)
    return found


def floor_beside(bed: Piece, side: float, depth_m: float) -> shapely.Polygon:
    """The strip of floor along a long side of a bed."""
    _, across, long_m, wide_m = _axes_of(bed)
    return _rectangle(bed.center + across * side * wide_m / 2, across * side, long_m, depth_m)


def pairs_at_bed(pieces: Sequence[Piece]) -> list[Finding]:
    """Outcome for the only bed and its two nightstands: they flank an end that may be its head."""
    beds, stands = rows_of(pieces, BEDS), rows_of(pieces, NIGHTSTANDS)
    if len(beds) != 1 or len(stands) != 2:
        return []
    places = {end_of_bed(pieces[beds[0]], pieces[row]) for row in stands}
    holds = any(places == {(end, -1.0), (end, 1.0)} for end in heads(pieces[beds[0]]))
    return [Finding((*beds, *stands), holds)]


def at_table(chair: Piece, table: Piece) -> bool:
    """True if a chair stands at a table."""
    return bool(chair.place.distance(table.place) <= AT_TABLE_M)


def seats_at(pieces: Sequence[Piece]) -> dict[int, int]:
    """Row of each chair that stands at a table, and of its table."""
    tables, found = rows_of(pieces, TABLES), {}
    for chair in rows_of(pieces, CHAIRS) if tables else []:
        apart_m = [pieces[chair].place.distance(pieces[row].place) for row in tables]
        table = tables[int(np.argmin(apart_m))]
        if at_table(pieces[chair], pieces[table]):
            found[chair] = table
    return found


def _seats(pieces: Sequence[Piece]) -> dict[str, list[Finding]]:
    """Chairs at tables, chairs turned to their table, and large tables with a chair."""
    tables = rows_of(pieces, TABLES)
    if not tables:
        return {}
    at = seats_at(pieces)
    large = [
        row
        for row in tables
        if max(pieces[row].size_m[::2]) >= LARGE_M and pieces[row].size_m[1] >= HIGH_M
    ]
    return {
        "chairs_at_tables": [Finding((chair,), chair in at) for chair in rows_of(pieces, CHAIRS)],
        "chairs_turned": [
            Finding((chair, table), pieces[chair].faces(pieces[table]))
            for chair, table in at.items()
            if pieces[chair].front is not None
        ],
        "tables_with_chairs": [Finding((row,), row in at.values()) for row in large],
    }


def _screens(pieces: Sequence[Piece]) -> list[Finding]:
    """Outcome for each screen: it and some sofa or bed face each other."""
    seats, screens = (
        [row for row in rows_of(pieces, labels) if pieces[row].front is not None]
        for labels in (SEATS, SCREENS)
    )
    if not seats:
        return []
    return [
        Finding((row,), any(opposite(pieces[row], pieces[seat]) for seat in seats))
        for row in screens
    ]


def opposite(one: Piece, other: Piece) -> bool:
    """True if two pieces face each other."""
    return one.faces(other) and other.faces(one)


def fronts(pieces: Sequence[Piece], floor: shapely.Geometry) -> dict[str, list[Finding]]:
    """Outcomes for pieces of `OPENED` classes: free floor before them, and something behind."""
    free, backed = [], []
    for row in rows_of(pieces, OPENED):
        piece = pieces[row]
        if piece.front is None or not piece.standing:
            continue
        others = [other for other in pieces if other is not piece and other.standing]
        blocking = [other for other in others if other.label not in (*CHAIRS, "stool")]
        free.append(Finding((row,), is_free(piece.before(BEFORE_M), blocking, floor)))
        walls = [floor.boundary, *(other.place for other in others)]
        backed.append(Finding((row,), piece.back_gap_m(walls) <= BACK_M))
    return {"fronts_free": free, "backs_covered": backed}


def is_free(place: shapely.Polygon, others: Iterable[Piece], floor: shapely.Geometry) -> bool:
    """True if `FREE_SHARE` of a place is in the room and free of others."""
    blocking = [other.place for other in others if other.size_m[1] > LOW_M]
    open_m2 = place.intersection(floor).difference(shapely.unary_union(blocking)).area
    return bool(open_m2 >= FREE_SHARE * place.area)
