"""The `Metric` record, and the sets of rooms that metrics compare."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int

from sceneprior.core.scene import Scene
from sceneprior.evaluation.bootstrap import Estimate, mean_of_rooms
from sceneprior.evaluation.features import Features
from sceneprior.evaluation.layout_distance import Nearest

Direction = Literal["closer", "lower", "higher", "half", "none"]
"""The better direction; `closer` marks a distance to the test rooms, where lower is better."""
ARROWS = {"closer": " ↓", "lower": " ↓", "higher": " ↑", "half": " → 0.5", "none": ""}
IN_WORDS = {"closer": "lower is closer", "half": "0.5 is best"}

AGAINST_TEST = ("train_rooms", "independent", "shuffled", "decoded_rooms", "generated")
"""Sets of rooms compared with the test rooms, by their names in a result; `decoded_rooms` exists
only for a prior that decodes its training rooms."""
PICTURED = ("train_rooms", "independent", "independent_meshes", *AGAINST_TEST[2:])
"""Sets whose pictures are compared: `AGAINST_TEST`, and the independent rooms drawn a second time
with the real meshes (the same layouts, other pictures)."""
EACH_SET = ("test", *AGAINST_TEST)
GENERATED = ("generated",)
USED = ("test", "shuffled", "independent", "generated")
"""Sets for which metrics of use (see use.py) are computed."""
Counts = Mapping[str, tuple[float | int, float | int]]
"""Numerator and denominator of each metric of use for one room, by key. The metric of a set is the
ratio of their sums over rooms; a room with denominator 0 is left out."""


@dataclass(frozen=True)
class RoomSet:
    """A set of rooms with the features, distances and resamples that metrics read."""

    scenes: Sequence[Scene]
    pictures: Features
    """Features of the rooms' pictures, objects drawn with their meshes if they have any; empty if
    no metric reads them."""
    box_pictures: Features | None
    """Features of pictures in which every object is drawn as its box; None without `--boxes`."""
    nearest: Nearest
    """Layout distances of each room to training rooms other than itself."""
    counts: Int[np.ndarray, "resamples rooms"]
    """Multiplicity of each room in each bootstrap resample."""

    def features(self, network: str, boxes: bool = False) -> np.ndarray:
        """A network's features of the rooms' pictures, or of the pictures with boxes. Under
        `small`, which the AlexNet classifier reads, these are the pictures themselves."""
        pictures = self.box_pictures if boxes else self.pictures
        assert pictures is not None  # metrics of boxes are computed only with `--boxes`
        return pictures[network]


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
    real: Sequence[Scene]
    """All real rooms that a classifier may train on: the training rooms and, if the split is
    `test`, the val rooms. The set `train_rooms` holds the same `Scene` objects."""
    seed: int
    """Seed of the classifiers' folds."""
    alexnet: Path | None
    plausible_pairs: Bool[np.ndarray, "classes classes"]
    """True for pairs of classes that also intersect in real rooms (`plausible_pairs`)."""
    near_copy_m: float
    """Distance to a training room with the same furniture below which a room is a near copy."""
    columns: dict[str, dict[str, Estimate]] = field(default_factory=dict)
    """Estimates computed so far, by set and key; generated rooms come last."""


@dataclass(frozen=True)
class TableColumn:
    """The column of a metric, or of a cost, in the table of `sceneprior compare`."""

    title: str
    digits: int
    note: str = ""
    """The sentence about the column in the table's caption."""


@dataclass(frozen=True)
class Metric:
    """A metric of a set of rooms, with its entries in tables; docs/evaluation.md defines it."""

    key: str
    """Key of the metric in result files."""
    title: str
    unit: str
    direction: Direction
    function: Callable[..., Any]
    """Computes an `Estimate` from a `RoomSet` and a `Comparison`; None if it needs decoded training
    rooms and there are none, and the result then leaves the metric out. (The metrics of
    metrics/decoded_rooms.py compute a number from a list of `SceneMatch` instead, and metrics of
    use, `USE` of the registry, compute the `Counts` of a scene.)"""
    sets: tuple[str, ...] = EACH_SET
    """Sets of rooms for which the metric is computed; the value of test rooms is `<key>_test`."""
    network: str | None = None
    """The network that reads the pictures (`inception`, `alexnet`, `effnet_lite0`), if any."""
    boxes: bool = False
    """True for metrics of pictures in which every object is drawn as its box (`--boxes`)."""
    protocol: Mapping[str, Any] = field(default_factory=dict)
    """Entries of the metric in the protocol of a result file."""
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
        return None if boxes or not self.boxes else "--boxes"
