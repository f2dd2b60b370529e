"""What a metric is, and the sets of rooms that metrics compare."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int

from sceneprior.evaluation.bootstrap import Estimate, mean_of_rooms, resample_counts
from sceneprior.evaluation.features import Features, rows_of
from sceneprior.evaluation.layout_distance import Nearest
from sceneprior.scene import Scene

Direction = Literal["closer", "lower", "higher", "half", "none"]
"""Which values are good; `closer` is a distance to the test rooms, the lower the closer."""
ARROWS = {"closer": " ↓", "lower": " ↓", "higher": " ↑", "half": " → 0.5", "none": ""}
IN_WORDS = {"closer": "lower is closer", "half": "0.5 is best"}

AGAINST_TEST = ("train_rooms", "independent", "shuffled", "decoded_rooms", "generated")
"""The sets of rooms that are compared with the test rooms, by their names in a result; decoded
training rooms where there are some."""
PICTURED = ("train_rooms", "independent", "independent_meshes", *AGAINST_TEST[2:])
"""Those, and independent rooms drawn with the real meshes: the same layouts, other pictures."""
EACH_SET = ("test", *AGAINST_TEST)
GENERATED = ("generated",)


@dataclass(frozen=True)
class RoomSet:
    """A set of rooms with all that metrics need of it."""

    scenes: Sequence[Scene]
    pictures: Features
    """Features of pictures of the rooms, drawn with their meshes where they have some."""
    box_pictures: Features | None
    """The same with every object drawn as its box; None where it was not asked for."""
    nearest: Nearest
    """Layout distances of each room to training rooms other than itself."""
    counts: Int[np.ndarray, "resamples rooms"]
    """How often each room is in each bootstrap resample."""

    def of(self, rows: Sequence[int], seed: tuple[int, ...]) -> "RoomSet":
        """Some of the rooms, with resamples of their own."""
        return replace(
            self,
            scenes=[self.scenes[row] for row in rows],
            pictures=rows_of(self.pictures, rows),
            box_pictures=self.box_pictures and rows_of(self.box_pictures, rows),
            nearest=self.nearest.of(rows),
            counts=resample_counts(len(rows), len(self.counts), seed),
        )

    def features(self, network: str, boxes: bool = False) -> np.ndarray:
        """Of each room what a network reads in its picture, or in the one that shows boxes; what
        the classifier learns from is the picture itself."""
        pictures = self.box_pictures if boxes else self.pictures
        assert pictures is not None  # metrics of boxes apply only where they are asked for
        return pictures[network]


def mean_over_rooms(
    of_room: Callable[[Scene], float | None], high: float = np.inf
) -> Callable[[RoomSet, "Comparison"], Estimate]:
    """The function of a metric that is a mean over rooms of a number from 0 to `high`.

    Rooms for which `of_room` gives None are left out.
    """

    def function(rooms: RoomSet, comparison: Comparison) -> Estimate:
        return mean_of_rooms([of_room(scene) for scene in rooms.scenes], rooms.counts, high)

    return function


@dataclass(frozen=True)
class Comparison:
    """What a set of rooms is compared with."""

    test: RoomSet
    fair: RoomSet
    """As many of the generated rooms as there are training rooms: Frechet distances compare at
    equal numbers alone."""
    seed: int
    """Of the classifiers' folds."""
    alexnet: Path | None
    plausible_pairs: Bool[np.ndarray, "classes classes"]
    """Which pairs of classes intersect in real rooms, too."""
    near_copy_m: float
    """Rooms nearer than this to a training room with the same furniture are copies of it."""
    columns: dict[str, dict[str, Estimate]] = field(default_factory=dict)
    """What is known so far, by set and key; generated rooms come last."""


@dataclass(frozen=True)
class TableColumn:
    """How a metric, or a cost, stands in the table of `sceneprior compare`."""

    title: str
    digits: int
    note: str = ""
    """Its part of the caption."""


@dataclass(frozen=True)
class Metric:
    """A number for a set of rooms, and everything that is said about it anywhere."""

    key: str
    """In result files."""
    title: str
    unit: str
    direction: Direction
    definition: str
    """One sentence (Markdown), for docs/evaluation.md."""
    function: Callable[..., Any]
    """Its `Estimate` from a `RoomSet` and a `Comparison`, or None where no decoded training rooms
    are known but it needs them: the result then leaves it out. (Of decoded training rooms against
    the truth, see metrics/decoded_rooms.py, a number from matched rooms.)"""
    sets: tuple[str, ...] = EACH_SET
    """The sets of rooms that have it; of test rooms it stands as `<key>_test`."""
    source: str = ""
    network: str | None = None
    """What reads the pictures: `inception`, `alexnet`, `effnet_lite0`; None where nothing does."""
    boxes: bool = False
    """Whether the pictures show every object as its box (`--boxes`)."""
    protocol: Mapping[str, Any] = field(default_factory=dict)
    """What the protocol of a result file says about it."""
    column: TableColumn | None = None
    """None leaves it out of the table of `compare`."""

    @property
    def subtitle(self) -> str:
        """Unit and direction, as they stand below the title."""
        return ", ".join(filter(None, (self.unit, IN_WORDS.get(self.direction))))

    def lacks(self, networks: Sequence[str], boxes: bool) -> str | None:
        """The option without which it cannot be measured; None where it can."""
        if self.network is not None and self.network not in networks:
            return f"--{self.network}"
        return None if boxes or not self.boxes else "--boxes"
