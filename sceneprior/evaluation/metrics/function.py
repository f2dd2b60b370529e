"""Function of furniture, as a person checks it first: nightstands at a bed's end, chairs at tables,
fronts that face free floor, televisions before sofas, usual numbers, sizes and places; and rooms
in which nothing of this is wrong."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from sceneprior.core.arrangements import BEDS, Piece, findings, pieces_of
from sceneprior.core.scene import Scene
from sceneprior.core.shell import floor_polygon
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
                sizes[piece.label].append(_extents(piece))
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


def _extents(piece: Piece) -> Float[np.ndarray, "3"]:
    width, height, depth = piece.size_m
    return np.array([*sorted((width, depth)), height])


def _numbers(scene: Scene) -> Counter[str]:
    found = Counter(item.label for item in scene.objects)
    return found + Counter(beds=sum(found[label] for label in BEDS))


def checks(scene: Scene, habits: Habits) -> dict[str, list[bool]]:
    """Outcomes of all checks that apply to a room, by the key of their metric."""
    pieces, floor = pieces_of(scene), floor_polygon(scene)
    found = {key: [each.holds for each in own] for key, own in findings(pieces, floor).items()} | {
        "usual_numbers": [
            number <= habits.most.get(label, 0) for label, number in _numbers(scene).items()
        ],
        "usual_sizes": [
            bool((low <= size).all() and (size <= high).all())
            for piece in pieces
            if piece.label in habits.sizes_m
            for (low, high), size in [(habits.sizes_m[piece.label], _extents(piece))]
        ],
    }
    if floor is not None:
        found["usual_places"] = [
            piece.place.distance(floor.boundary) <= habits.from_wall_m[piece.label]
            for piece in pieces
            if piece.label in habits.from_wall_m
        ]
    return found


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
