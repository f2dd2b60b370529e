"""Every figure of a set of rooms, with its resamples: scenes and features in, `Figure`s out."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from sceneprior.classes import VOID, label_set
from sceneprior.evaluation.alexnet import classify_pictures
from sceneprior.evaluation.bootstrap import Figure, ratio, resample_counts
from sceneprior.evaluation.classifier import found_out
from sceneprior.evaluation.features import SceneFeatures
from sceneprior.evaluation.metrics.free_space import outside_count, walkable_share
from sceneprior.evaluation.metrics.layout_metrics import (
    category_kl,
    common_label_set,
    frequency_kl,
    holds_its_type,
    object_counts,
    room_overlaps,
)
from sceneprior.evaluation.metrics.novelty import NEAR_COPY_M
from sceneprior.evaluation.metrics.set_metrics import (
    frechet_distance,
    gap_closed,
    kernel_distance,
    kernels,
    precision_recall,
)
from sceneprior.scene import Scene

FRECHET = {"effnet_lite0": "fd_effnet_lite0", "inception": "fid"}
"""What the Frechet distance is called, by the network that reads the pictures."""


@dataclass(frozen=True)
class Rooms:
    """One set of rooms, with all that figures ask of it."""

    scenes: Sequence[Scene]
    features: SceneFeatures
    nearest_training_m: Float[np.ndarray, " rooms"]
    """Layout distance of each room to the nearest training room other than itself."""
    counts: Int[np.ndarray, "resamples rooms"]
    """How often each room is in each resample."""

    def of(self, rows: Sequence[int], seed: tuple[int, ...]) -> "Rooms":
        """Some of the rooms, with draws of their own."""
        scenes = [self.scenes[row] for row in rows]
        nearest = self.nearest_training_m[list(rows)]
        return rooms_of(scenes, self.features.of(rows), nearest, len(self.counts), seed)

    @cached_property
    def class_counts(self) -> Int[np.ndarray, "rooms classes"]:
        """Objects of each class in each room, void left out."""
        classes = len(label_set(common_label_set(self.scenes)))
        rows = [np.bincount(scene.class_indices, minlength=classes) for scene in self.scenes]
        table = np.stack(rows)
        table[:, VOID] = 0
        return table


def rooms_of(
    scenes: Sequence[Scene],
    features: SceneFeatures,
    nearest_training_m: Float[np.ndarray, " rooms"],
    resamples: int,
    seed: tuple[int, ...],
) -> Rooms:
    """A set of rooms with its own draws."""
    counts = resample_counts(len(scenes), resamples, seed)
    return Rooms(scenes, features, nearest_training_m, counts)


def figures_alone(rooms: Rooms) -> dict[str, Figure]:
    """What a set of rooms is by itself, room by room; docs/evaluation.md defines each."""
    each = np.ones(len(rooms.scenes))
    overlaps = [room_overlaps(scene) for scene in rooms.scenes]
    pairs, hits, volumes = np.array([[o.pairs, o.hits, o.volume_m3] for o in overlaps]).T
    outside, judged = np.array([outside_count(scene) for scene in rooms.scenes], dtype=float).T
    near_copies = rooms.nearest_training_m < NEAR_COPY_M
    figures = {
        "mean_objects": ratio(object_counts(rooms.scenes), each, rooms.counts),
        "overlap_pairs": ratio(hits, each, rooms.counts),
        # A set of rooms with one object each holds no pair that could intersect: 0, not nothing.
        "overlap_pair_share": ratio(hits, pairs, rooms.counts, 1.0)
        if pairs.any()
        else ratio(hits, each, rooms.counts, 1.0),
        "overlap_volume_m3": ratio(volumes, each, rooms.counts),
        "out_of_bounds_share": ratio(outside, judged, rooms.counts, 1.0),
        "walkable_share": _mean_of_known(
            [walkable_share(scene) for scene in rooms.scenes], rooms.counts
        ),
        "walkable_share_floor": _mean_of_known(
            [walkable_share(scene, "floor") for scene in rooms.scenes], rooms.counts
        ),
        "nearest_training_m": ratio(rooms.nearest_training_m, each, rooms.counts),
        "near_copy_share": ratio(near_copies.astype(float), each, rooms.counts, 1.0),
    }
    holds = holds_its_type(rooms.scenes)
    known = each if holds is not None else 0 * each
    figures["type_share"] = ratio(
        0 * each if holds is None else holds.astype(float), known, rooms.counts, 1.0
    )
    return figures


def _mean_of_known(values: Sequence[float | None], counts: np.ndarray) -> Figure:
    known = np.array([value is not None for value in values], dtype=float)
    return ratio(np.array([value or 0.0 for value in values]), known, counts, 1.0)


def figures_against(
    rooms: Rooms, test: Rooms, seed: int, inception: bool, alexnet: Path | None
) -> dict[str, Figure]:
    """How pictures of a set of rooms compare with those of test rooms; docs/evaluation.md defines.

    Args:
        rooms: Generated rooms, or any others.
        test: The test rooms.
        seed: Of the classifiers' folds.
        inception: Whether features of the Inception network are to be used, too.
        alexnet: Weights of the paper's classifier, or None.
    """
    a, b = rooms.features, test.features
    figures = _feature_figures(rooms, test, a.effnet_lite0, b.effnet_lite0, "effnet_lite0")
    told = found_out(a.effnet_lite0, b.effnet_lite0, seed)
    figures["sca_effnet_lite0"] = told.accuracy(rooms.counts, test.counts)
    if inception and a.inception is not None and b.inception is not None:
        figures |= _feature_figures(rooms, test, a.inception, b.inception, "inception")
        figures["kid"] = figures.pop("kid_inception")
    if alexnet is not None and a.small is not None and b.small is not None:
        # One draw of folds: ten epochs of AlexNet, five times, are minutes.
        told = found_out(a.small, b.small, seed, partial(classify_pictures, alexnet), repeats=1)
        figures["sca"] = told.accuracy(rooms.counts, test.counts)
    return figures


def _feature_figures(
    rooms: Rooms, test: Rooms, a: np.ndarray, b: np.ndarray, network: str
) -> dict[str, Figure]:
    pairs = kernels(a, b)
    kernel_draws = kernel_distance(pairs, rooms.counts, test.counts)
    inside, covered = precision_recall(a, b)
    return {
        FRECHET[network]: _frechet(rooms, test, a, b),
        f"kid_{network}": Figure(float(kernel_distance(pairs)[0]), kernel_draws),
        f"precision_{network}": ratio(inside.astype(float), np.ones(len(a)), rooms.counts, 1.0),
        f"recall_{network}": ratio(covered.astype(float), np.ones(len(b)), test.counts, 1.0),
    }


def _frechet(rooms: Rooms, test: Rooms, a: np.ndarray, b: np.ndarray) -> Figure:
    draws = zip(rooms.counts, test.counts, strict=True)
    return Figure(
        frechet_distance(a, b), np.array([frechet_distance(a, b, *draw) for draw in draws]), 0.0
    )


def frechet_figures(rooms: Rooms, test: Rooms) -> dict[str, Figure]:
    """Frechet distances of a set's pictures to those of test rooms, by every network at hand."""
    figures = {}
    for network, key in FRECHET.items():
        a, b = getattr(rooms.features, network), getattr(test.features, network)
        if a is not None and b is not None:
            figures[key] = _frechet(rooms, test, a, b)
    return figures


def gap_figures(
    rooms: Rooms, test: Rooms, independent: dict[str, Figure], real: dict[str, Figure]
) -> dict[str, Figure]:
    """The share of the gap between independent and real rooms that a set has closed, by network.

    Args:
        rooms: As many rooms as the two others are.
        test: The test rooms.
        independent: `figures_against` of rooms from `independent_rooms`.
        real: The same of real training rooms.
    """
    figures = {}
    names = {key: network for network, key in FRECHET.items()}
    for key, distance in frechet_figures(rooms, test).items():
        if key not in real:
            continue
        distances = (distance, independent[key], real[key])
        value = gap_closed(*(distance.value or 0.0 for distance in distances))
        # A resample repeats rooms, which moves all distances up: each back to its own mean.
        moved = [(d.value or 0.0) + d.draws - d.draws.mean() for d in distances if len(d.draws)]
        draws = np.array([gap_closed(*draw) for draw in zip(*moved, strict=True)])
        figures[f"gap_closed_{names[key]}"] = Figure(value, draws)
    return figures


def category_kl_figure(rooms: Rooms, test: Rooms) -> Figure:
    """`category_kl` with its resamples."""

    def frequencies(counts: np.ndarray) -> np.ndarray:
        return np.asarray(counts / np.maximum(counts.sum(-1, keepdims=True), 1))

    p = frequencies(test.counts @ test.class_counts)
    q = frequencies(rooms.counts @ rooms.class_counts)
    draws = np.array([frequency_kl(*pair) for pair in zip(p, q, strict=True)])
    return Figure(category_kl(rooms.scenes, test.scenes), draws, 0.0)
