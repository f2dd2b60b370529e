"""Function of furniture, as a person checks it first: nightstands at a bed's end, chairs at tables,
fronts that face free floor, televisions before sofas, usual numbers, sizes and places; and rooms
in which nothing of this is wrong."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import shapely
from jaxtyping import Float

from sceneprior.core.colliders import support_of
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shell import floor_polygon
from sceneprior.evaluation.geometry import footprint, own_box
from sceneprior.evaluation.metric import (
    DEFINED,
    Comparison,
    Estimate,
    RoomSet,
    TableColumn,
    mean_of_rooms,
    metric,
    ratio,
)

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
"""Share of the floor before a front that must be in the room and free."""
BACK_M = 0.1
"""Largest distance of a back from a wall or another piece."""
LOW_M = 0.15
"""Height below which a piece, such as a rug, blocks no front."""
RARE = 0.01
"""Share of the training objects at each end of a quantity whose values are unusual."""
MARGIN = 0.1
"""Share of a size by which an object may pass the training objects' quantiles."""
MARGIN_M = 0.1
"""Distance by which an object may stand farther from walls than training objects."""
FEWEST = 20
"""Minimum number of training objects from which usual sizes and places of a class are known."""
EXPECTED = 0.8
"""Share of the training rooms' checks that must succeed for a failure to be a fault: what one real
room in five does is a habit."""


class Piece(NamedTuple):
    """A piece of furniture on the floor plan."""

    item: SceneObject
    place: shapely.Polygon
    """Its footprint."""
    center: Float[np.ndarray, "2"]
    front: Float[np.ndarray, "2"] | None
    """Unit vector (x, z) along its front; None if its yaw is unknown."""
    standing: bool
    """False for lamps and other pieces that hang."""

    @property
    def label(self) -> str:
        """The class."""
        return self.item.label

    def before(self, depth_m: float) -> shapely.Polygon:
        """The rectangle before the front, as wide as the piece; behind it if the depth is
        negative. The yaw must be known."""
        assert self.front is not None
        width, _, depth = own_box(self.item).size_m
        across = np.array([self.front[1], -self.front[0]]) * width / 2
        edge = self.center + self.front * np.copysign(depth / 2, depth_m)
        far = edge + self.front * depth_m
        return shapely.Polygon([edge - across, edge + across, far + across, far - across])

    def faces(self, other: "Piece") -> bool:
        """True if the other piece's centre lies within `TOWARDS_RAD` of the front."""
        assert self.front is not None
        away = other.center - self.center
        return bool(away @ self.front >= np.cos(TOWARDS_RAD) * np.linalg.norm(away) - 1e-9)


def pieces_of(scene: Scene) -> list[Piece]:
    """The furniture of a scene on its floor plan."""
    pieces = []
    for item in scene.objects:
        front = None
        if item.turned is not None:
            front = np.array([np.sin(item.turned.yaw_rad), np.cos(item.turned.yaw_rad)])
        center = np.array(item.center_m)[::2]
        place = shapely.Polygon(footprint(item))
        pieces.append(Piece(item, place, center, front, support_of(item) == "ground"))
    return pieces


@dataclass(frozen=True)
class Habits:
    """Usual numbers, sizes and places of furniture in training rooms."""

    most: dict[str, int]
    """Largest number of each class in a room; of all `BEDS` together under `beds`."""
    sizes_m: dict[str, Float[np.ndarray, "2 3"]]
    """Smallest and largest usual extents of a class: shorter side, longer side, height."""
    from_wall_m: dict[str, float]
    """Largest usual distance of a class's footprints from the walls."""
    faults: frozenset[str] = frozenset()
    """Keys of the checks that at least `EXPECTED` of the training rooms' pieces pass."""

    @classmethod
    def of(cls, rooms: Sequence[Scene]) -> "Habits":
        """The habits of training rooms."""
        most: dict[str, int] = {}
        sizes, gaps = defaultdict(list), defaultdict(list)
        for scene in rooms:
            for label, number in _numbers(scene).items():
                most[label] = max(most.get(label, 0), number)
            floor = floor_polygon(scene)
            for piece in pieces_of(scene):
                sizes[piece.label].append(_extents(piece.item))
                if floor is not None:
                    gaps[piece.label].append(piece.place.distance(floor.boundary))
        habits = cls(
            most,
            {label: _usual(found) for label, found in sizes.items() if len(found) >= FEWEST},
            {
                label: float(np.quantile(found, 1 - RARE)) + MARGIN_M
                for label, found in gaps.items()
                if len(found) >= FEWEST
            },
        )
        outcomes: dict[str, list[bool]] = defaultdict(list)
        for scene in rooms:
            for key, found in checks(scene, habits).items():
                outcomes[key] += found
        passed = {key for key, found in outcomes.items() if found and np.mean(found) >= EXPECTED}
        return replace(habits, faults=frozenset(passed))


def _usual(sizes_m: Sequence[np.ndarray]) -> Float[np.ndarray, "2 3"]:
    low, high = np.quantile(np.array(sizes_m), [RARE, 1 - RARE], axis=0)
    return np.array([low / (1 + MARGIN), high * (1 + MARGIN)])


def _extents(item: SceneObject) -> Float[np.ndarray, "3"]:
    width, height, depth = own_box(item).size_m
    return np.array([*sorted((width, depth)), height])


def _numbers(scene: Scene) -> Counter[str]:
    found = Counter(item.label for item in scene.objects)
    return found + Counter(beds=sum(found[label] for label in BEDS))


def checks(scene: Scene, habits: Habits) -> dict[str, list[bool]]:
    """Outcomes of all checks that apply to a room, by the key of their metric."""
    pieces, floor = pieces_of(scene), floor_polygon(scene)
    found = {
        "pairs_at_bed": _pairs(pieces),
        **_seats(pieces),
        "screens_seen": _screens(pieces),
        "usual_numbers": [
            number <= habits.most.get(label, 0) for label, number in _numbers(scene).items()
        ],
        "usual_sizes": [
            bool((low <= size).all() and (size <= high).all())
            for piece in pieces
            if piece.label in habits.sizes_m
            for (low, high), size in [(habits.sizes_m[piece.label], _extents(piece.item))]
        ],
    }
    if floor is not None:
        found |= _fronts(pieces, floor)
        found["usual_places"] = [
            piece.place.distance(floor.boundary) <= habits.from_wall_m[piece.label]
            for piece in pieces
            if piece.label in habits.from_wall_m
        ]
    return found


def _pairs(pieces: Sequence[Piece]) -> list[bool]:
    """Outcome for the only bed and its two nightstands: they flank one of its ends."""
    beds = [piece for piece in pieces if piece.label in BEDS]
    stands = [piece for piece in pieces if piece.label in NIGHTSTANDS]
    if len(beds) != 1 or len(stands) != 2:
        return []
    bed = beds[0]
    corners = shapely.get_coordinates(bed.place)[:4]
    sides = np.roll(corners, -1, axis=0) - corners
    lengths = np.linalg.norm(sides, axis=1)
    long = int(lengths[1] > lengths[0])
    along, across = sides[long] / lengths[long], sides[1 - long] / lengths[1 - long]
    offsets = np.array([stand.center - bed.center for stand in stands])
    ends, flanks = np.sign(offsets @ along), np.sign(offsets @ across)
    to_end = np.abs(np.abs(offsets @ along) - lengths[long] / 2)
    edges = [shapely.LineString([corners[k], corners[(k + 1) % 4]]) for k in (long, long + 2)]
    near = [min(edge.distance(stand.place) for edge in edges) <= BESIDE_M for stand in stands]
    return [
        bool(ends[0] == ends[1] and flanks.prod() < 0 and (to_end <= AT_END_M).all() and all(near))
    ]


def _seats(pieces: Sequence[Piece]) -> dict[str, list[bool]]:
    """Chairs at tables, chairs turned to their table, and large tables with a chair."""
    chairs = [piece for piece in pieces if piece.label in CHAIRS]
    tables = [piece for piece in pieces if piece.label in TABLES]
    if not tables:
        return {}
    at = [
        (chair, table)
        for chair in chairs
        for table in [min(tables, key=lambda each: chair.place.distance(each.place))]
        if chair.place.distance(table.place) <= AT_TABLE_M
    ]
    large = [
        table
        for table in tables
        if max(own_box(table.item).size_m[::2]) >= LARGE_M and table.item.size_m[1] >= HIGH_M
    ]
    return {
        "chairs_at_tables": [any(chair is each for each, _ in at) for chair in chairs],
        "chairs_turned": [chair.faces(table) for chair, table in at if chair.front is not None],
        "tables_with_chairs": [any(table is each for _, each in at) for table in large],
    }


def _screens(pieces: Sequence[Piece]) -> list[bool]:
    """Outcome for each screen: it and some sofa or bed face each other."""
    seats = [piece for piece in pieces if piece.label in SEATS and piece.front is not None]
    screens = [piece for piece in pieces if piece.label in SCREENS and piece.front is not None]
    if not seats:
        return []
    return [any(screen.faces(seat) and seat.faces(screen) for seat in seats) for screen in screens]


def _fronts(pieces: Sequence[Piece], floor: shapely.Geometry) -> dict[str, list[bool]]:
    """Outcomes for pieces of `OPENED` classes: free floor before them, and something behind."""
    free, backed = [], []
    for piece in pieces:
        if piece.label not in OPENED or piece.front is None or not piece.standing:
            continue
        others = [other for other in pieces if other is not piece and other.standing]
        before = piece.before(BEFORE_M)
        blocking = [
            other.place
            for other in others
            if other.item.size_m[1] > LOW_M and other.label not in (*CHAIRS, "stool")
        ]
        open_m2 = before.intersection(floor).difference(shapely.unary_union(blocking)).area
        free.append(open_m2 >= FREE_SHARE * before.area)
        back = shapely.LineString(shapely.get_coordinates(piece.before(-BACK_M))[:2])
        walls = [floor.boundary, *(other.place for other in others)]
        middle = back.interpolate(0.5, normalized=True)
        backed.append(min(middle.distance(wall) for wall in walls) <= BACK_M)
    return {"fronts_free": free, "backs_covered": backed}


_SHARE, _KNOWN = "share of pieces", "share of pieces with a known yaw"


@metric(
    "rooms_without_fault",
    "Rooms in which no check of function fails",
    "share of rooms",
    "higher",
    protocol=f"checks that at least {EXPECTED:.0%} of the training rooms' pieces pass",
    column=TableColumn("no fault", 2, "no fault: rooms in which every check of function succeeds"),
)
@metric("pairs_at_bed", "Two nightstands at one end of the bed", "share of rooms", "higher")
@metric("chairs_at_tables", "Chairs at a table", "share of chairs", "higher")
@metric("chairs_turned", "Chairs that face their table", "share of chairs", "higher")
@metric("tables_with_chairs", "Large tables with a chair", "share of tables", "higher")
@metric("screens_seen", "Televisions and seats that face each other", _KNOWN, "higher")
@metric("fronts_free", "Fronts with free floor before them", _KNOWN, "higher")
@metric("backs_covered", "Backs at a wall or a piece", _KNOWN, "higher")
@metric("usual_numbers", "Numbers that training rooms have", "share of classes", "higher")
@metric("usual_sizes", "Sizes that training objects have", _SHARE, "higher")
@metric("usual_places", "Distances from walls that training objects have", _SHARE, "higher")
def measure_function(rooms: RoomSet, comparison: Comparison) -> dict[str, Estimate]:
    """The share of checks that succeed, by key, and of rooms in which none fails."""
    habits = Habits.of(comparison.train)
    outcomes = [checks(scene, habits) for scene in rooms.scenes]
    faulty = [any(not all(room[key]) for key in habits.faults & room.keys()) for room in outcomes]
    keys = [each.key for each in DEFINED if each.function is measure_function]
    return {
        key: ratio(
            np.array([sum(room.get(key, [])) for room in outcomes]),
            np.array([len(room.get(key, [])) for room in outcomes]),
            rooms.counts,
            1.0,
        )
        for key in keys[1:]
    } | {keys[0]: mean_of_rooms(~np.array(faulty, dtype=bool), rooms.counts, 1.0)}
