"""The `Metric` record, the sets of rooms that metrics compare, and their estimates with bootstrap
intervals."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from jaxtyping import Bool, Float, Int, Real, Shaped

from sceneprior.core.scene import Scene
from sceneprior.evaluation.features import Features

RESAMPLES = 200
COVERAGE = 0.95
METHOD = (
    f"{COVERAGE:.0%} bootstrap over rooms, both sets resampled with replacement; quantiles shifted "
    "so that the mean of the resamples equals the metric's value"
)


def resample_counts(
    rooms: int, resamples: int, seed: int | tuple[int, ...]
) -> Int[np.ndarray, "sets rooms"]:
    """Count how often each room occurs in the set itself (row 0: once), and in each resample of
    `rooms` drawn with replacement."""
    shares = np.full(rooms, 1 / rooms)
    drawn = np.random.default_rng(seed).multinomial(rooms, shares, size=resamples)
    return np.insert(drawn, 0, 1, axis=0)


@dataclass(frozen=True)
class Estimate:
    """A metric's value on the rooms and on every resample of them."""

    values: Float[np.ndarray, " sets"]
    """Values on the rooms themselves (first) and on each resample; NaN if undefined."""
    low: float = -np.inf
    high: float = np.inf
    """Bounds of the metric by definition; the interval is clipped to [low, high]."""

    @property
    def value(self) -> float | None:
        """Value on the rooms themselves; None if the metric is undefined for this set."""
        return float(self.values[0]) if np.isfinite(self.values[0]) else None

    @property
    def undefined(self) -> "Estimate":
        """The same estimate without values."""
        return Estimate(np.full_like(self.values, np.nan), self.low, self.high)

    def interval(self) -> list[float] | None:
        """Lower and upper end of the interval; None if there is no value or there are no resamples.

        Drawing with replacement repeats rooms, and sets with fewer distinct rooms lie farther
        apart: the resamples of a Frechet distance all lie above the distance itself. This bias is
        removed: the quantiles are shifted so that the mean of the resamples equals the value.
        """
        known = self.values[np.isfinite(self.values)][1:]
        if self.value is None or len(known) == 0:
            return None
        tail = (1 - COVERAGE) / 2
        ends = self.value + np.quantile(known, [tail, 1 - tail]) - known.mean()
        return [float(end) for end in np.clip(ends, self.low, self.high)]

    def combined(
        self,
        other: "Estimate",
        function: Callable[[Any, Any], Any],
        low: float = -np.inf,
        high: float = np.inf,
    ) -> "Estimate":
        """A function of this metric and another, on the rooms and on each resample; undefined where
        either metric is, or the function is not finite."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return Estimate(function(self.values, other.values), low, high)


def ratio(
    numerators: Real[np.ndarray, " rooms"],
    denominators: Real[np.ndarray, " rooms"],
    counts: Int[np.ndarray, "sets rooms"],
    high: float = np.inf,
) -> Estimate:
    """The ratio of two sums over rooms, from 0 to `high`, such as a mean over rooms or objects.

    A denominator of 0 leaves its room out. If all are 0, the ratio is undefined.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        return Estimate((counts @ numerators) / (counts @ denominators), 0.0, high)


def mean_of_rooms(
    values: Sequence[float | int | None] | Shaped[np.ndarray, " rooms"],
    counts: Int[np.ndarray, "sets rooms"],
    high: float = np.inf,
) -> Estimate:
    """The mean over rooms of non-negative values; rooms with None are left out."""
    known = np.array([value is not None for value in values], dtype=float)
    return ratio(np.array([value or 0.0 for value in values], dtype=float), known, counts, high)


def mean_of_shares(a: Estimate, b: Estimate) -> Estimate:
    """The mean of two shares, from 0 to 1; undefined if either share is undefined."""
    return a.combined(b, lambda one, other: (one + other) / 2, 0.0, 1.0)


Function = TypeVar("Function", bound=Callable[..., Any])
Direction = Literal["closer", "lower", "higher", "half", "none"]
"""The better direction; `closer` marks a distance to the test rooms, where lower is better."""
ARROWS = {"closer": " ↓", "lower": " ↓", "higher": " ↑", "half": " → 0.5", "none": ""}
IN_WORDS = {"closer": "lower is closer", "half": "0.5 is best"}

AGAINST_TEST = ("train_rooms", "independent", "shuffled", "decoded_rooms", "generated")
"""Sets of rooms compared with the test rooms, by their names in a result; `decoded_rooms` exists
only for a prior that decodes its training rooms."""
PICTURED = (
    "train_rooms", "independent", "independent_meshes", "shuffled", "shuffled_meshes",
    *AGAINST_TEST[3:],
)  # fmt: skip
"""Sets whose pictures are compared: `AGAINST_TEST`, and the independent and the shuffled rooms
drawn a second time with the real meshes (the same layouts, other pictures)."""
EACH_SET = ("test", *AGAINST_TEST)
GENERATED = ("generated",)
USED = ("test", "shuffled", "independent", "generated")
"""Sets for which metrics of use (see use.py) are computed."""
MATCHED: tuple[str, ...] = ()
"""No set: the metric compares decoded training rooms with their ground truth."""
Counts = Mapping[str, tuple[float | int, float | int]]
"""Numerator and denominator of each metric of use for one room, by key. The metric of a set is the
ratio of their sums over rooms; a room with denominator 0 is left out."""


@dataclass(frozen=True)
class RoomSet:
    """A set of rooms with the features and resamples that metrics read."""

    scenes: Sequence[Scene]
    pictures: Features
    """Features of the rooms' pictures, objects drawn with their meshes if they have any, and with
    the suffix `_boxes` those of pictures in which every object is drawn as its box; empty if no
    metric reads them."""
    counts: Int[np.ndarray, "sets rooms"]
    """Multiplicity of each room: 1 in row 0, then in each bootstrap resample."""


EMPTY = "generated rooms are empty"
"""Words of a note by which pages recognise it."""


def emptiness(scenes: Sequence[Scene]) -> str | None:
    """A warning if more than half of the generated rooms are empty; else None.

    Metrics of empty rooms mislead: no objects intersect, and a blank picture easily lies in the
    ball around a real room's picture, which raises precision.
    """
    empty = sum(not scene.objects for scene in scenes)
    if 2 * empty <= len(scenes):
        return None
    return (
        f"{empty} of {len(scenes)} {EMPTY}, so none of the other scores can be "
        "trusted: train longer."
    )


def mean_over_rooms(
    of_room: Callable[[Scene], float | None], high: float = np.inf
) -> Callable[[RoomSet, "Comparison"], Estimate]:
    """Build a metric's function: the mean over rooms of `of_room`, a number from 0 to `high`.

    Rooms for which `of_room` returns None are left out.
    """

    def function(rooms: RoomSet, comparison: Comparison) -> Estimate:
        return mean_of_rooms([of_room(scene) for scene in rooms.scenes], rooms.counts, high)

    return function


@dataclass(frozen=True)
class Comparison:
    """The rooms and settings that a set of rooms is compared with."""

    test: RoomSet
    train: Sequence[Scene]
    """All training rooms. The set `train_rooms` holds the same `Scene` objects."""
    val: Sequence[Scene]
    """The val rooms, on which classifiers may train too; empty if `test` holds the val split."""
    decoded: Sequence[Scene]
    """Training rooms as the prior decodes them, if it does, named like the true ones."""
    seed: int
    """Seed of the classifiers' folds."""
    alexnet: Path | None
    plausible_pairs: Bool[np.ndarray, "classes classes"]
    """True for pairs of classes that also intersect in real rooms (`plausible_pairs`)."""
    near_copy_m: float
    """Distance to a training room with the same furniture below which a room is a near copy."""
    columns: dict[str, dict[str, Estimate]] = field(default_factory=dict)
    """Estimates computed so far, by set and key; generated rooms come last."""

    def is_training_set(self, rooms: RoomSet) -> bool:
        """True if the rooms are training rooms themselves."""
        return any(rooms.scenes[0] is other for other in self.train)


@dataclass(frozen=True)
class TableColumn:
    """The column of a metric, or of a cost, in the table of `sceneprior compare`."""

    title: str
    digits: int
    note: str = ""
    """The sentence about the column in the table's caption."""
    direction: Direction = "none"
    """The better direction; tables of rooms take the metric's."""

    @property
    def heading(self) -> str:
        """The title with an arrow in the better direction."""
        return self.title + ARROWS[self.direction]


@dataclass(frozen=True)
class Metric:
    """A metric of a set of rooms, with its entries in tables; docs/evaluation.md defines it."""

    key: str
    """Key of the metric in result files."""
    title: str
    unit: str
    direction: Direction
    function: Callable[..., Any]
    """Computes an `Estimate`, or those of several metrics by key, from a `RoomSet` and a
    `Comparison`; None if it needs decoded training rooms and there are none, and the result then
    leaves the metric out. A metric of `USED` rooms
    computes the `Counts` of a scene, and one of `MATCHED` rooms a number from a list of
    `SceneMatch`."""
    sets: tuple[str, ...] = EACH_SET
    """Sets of rooms for which the metric is computed; the value of test rooms is `<key>_test`."""
    network: str | None = None
    """The network that reads the pictures (`inception`, `alexnet`, `effnet_lite0`), if any."""
    needs: str = "a floor (floor_m) in the scenes"
    """Parts of a room that a metric of use needs besides objects."""
    protocol: Mapping[str, Any] = field(default_factory=dict)
    """Entries of the metric in the protocol of a result file; text is the entry of its own key."""
    column: TableColumn | None = None
    """The metric's column in the table of `sceneprior compare`; None leaves the metric out."""

    @property
    def subtitle(self) -> str:
        """Unit and direction, shown below the title."""
        return ", ".join(filter(None, (self.unit, IN_WORDS.get(self.direction))))

    def lacks(self, networks: Sequence[str], boxes: bool) -> str | None:
        """The option that the metric needs and the user left out; None if nothing is missing."""
        if self.network is not None and self.network not in networks:
            return f"--{self.network}"
        return "--boxes" if self.key.endswith("_boxes") and not boxes else None


DEFINED: list[Metric] = []
"""All metrics, in the order of their definitions; metrics/__init__.py sorts them."""


def metric(
    key: str, title: str, unit: str, direction: Direction, *rest: Any, **more: Any
) -> Callable[[Function], Function]:
    """Define the decorated function as the metric `key`; `Metric` describes the arguments.

    A function that computes several metrics, such as the `Counts` of a scene, is decorated once
    for each.
    """

    if isinstance(more.get("protocol"), str):
        more["protocol"] = {key: more["protocol"]}

    def define(function: Function) -> Function:
        # Decorators run from the last to the first; tables show the first above the last.
        known = (row for row, other in enumerate(DEFINED) if other.function is function)
        made = Metric(key, title, unit, direction, function, *rest, **more)
        DEFINED.insert(next(known, len(DEFINED)), made)
        return function

    return define
