"""Metrics of use, which test whether rooms suit simulation: collisions, support, free floor, doors,
volumes, stability."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from sceneprior.core.contact_resolution import make_stable
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import independent_rooms, reference_scenes, shuffled_rooms
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import METHOD, Counts, Estimate, Metric, ratio, resample_counts
from sceneprior.evaluation.metrics import USE
from sceneprior.evaluation.metrics.contents import common_label_set
from sceneprior.evaluation.metrics.stability import stable_count
from sceneprior.evaluation.room_sets import without_void
from sceneprior.evaluation.synthesis import FORMAT, VERSION, EvalOptions, result_of

SETTLED = ("solids", "all", "none")
"""Choices of rooms to simulate: those whose objects all have solids or no mesh; all; or none."""


@dataclass(frozen=True)
class UseOptions:
    """Settings of the metrics of use."""

    settle: str = "solids"
    """Rooms that are simulated, one of `SETTLED`. A mesh without solids is divided into convex
    parts first, which takes up to two minutes for one object with 3,000 triangles."""
    alone: bool = False
    """Compute the metrics of use only."""
    stand: bool = False
    """First make the objects of generated rooms stand, by setting them down, adding feet and moving
    them apart (`make_stable`)."""

    def __post_init__(self) -> None:
        if self.settle not in SETTLED:
            raise InputError(
                f"--settle {self.settle} is not known; choose from {', '.join(SETTLED)}."
            )


def measure_use(
    sets: Mapping[str, Sequence[Scene]], seed: int, resamples: int, options: UseOptions
) -> tuple[dict[str, dict[str, Estimate]], dict[str, str]]:
    """Compute all metrics of use for sets of rooms, with intervals over rooms.

    Returns:
        The metrics by set and key; and the metrics that are left out of all sets, each with what
        no generated room has (a floor, doors or windows).
    """
    columns = {}
    total = sum(map(len, sets.values()))
    with Progress(console=Console(stderr=True)) as bars:
        bar = bars.add_task("Measuring rooms", total=total)
        for number, (name, scenes) in enumerate(sets.items()):
            measured = []
            for scene in scenes:
                measured.append(measure_room(scene, options))
                bars.advance(bar)
            # These seeds are far from those of `room_sets`.
            counts = resample_counts(len(scenes), resamples, (seed, 100 + number))
            columns[name] = {metric.key: _estimate(metric.key, measured, counts) for metric in USE}
    missing = [metric for metric in USE if columns["generated"][metric.key].value is None]
    reasons = {metric.key: _reason(metric, sets["generated"], options) for metric in missing}
    for found in columns.values():
        for key in reasons:
            del found[key]
    return columns, reasons


def measure_room(scene: Scene, options: UseOptions) -> Counts:
    """Numerators and denominators of all metrics of use, for one room."""
    found: dict[str, tuple[float | int, float | int]] = {}
    functions: dict[Callable[..., Any], None] = dict.fromkeys(metric.function for metric in USE)
    for function in functions:
        if function is not stable_count or _simulated(scene, options):
            found |= function(scene)
    return found


def _simulated(scene: Scene, options: UseOptions) -> bool:
    if options.settle == "none" or find_spec("mujoco") is None:
        return False
    ready = all(item.solids or item.mesh is None for item in scene.objects)
    return ready or options.settle == "all"


def _estimate(key: str, measured: Sequence[Counts], counts: np.ndarray) -> Estimate:
    pairs = np.array([each.get(key, (0.0, 0.0)) for each in measured], dtype=float).reshape(-1, 2)
    litres = key.endswith("litres")
    return ratio(pairs[:, 0], pairs[:, 1], counts, np.inf if litres else 1.0)


def _reason(metric: Metric, scenes: Sequence[Scene], options: UseOptions) -> str:
    if metric.function is stable_count:
        if options.settle == "none":
            return "--settle solids"
        if find_spec("mujoco") is None:
            return "mujoco (pip install 'sceneprior[sim]')"
    elif not any(scene.objects for scene in scenes):
        return "objects in the scenes"
    return metric.needs


def evaluate_use(
    generated: Sequence[Scene],
    options: EvalOptions,
    use: UseOptions,
    shards: Path | None = None,
    scores: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Compute metrics of use for generated rooms and, with shards, for real and random rooms.

    Args:
        shards: Shards with 3D ground truth; None measures the generated rooms alone.
        scores: A result of the same rooms that is to be extended; a new one if None.

    Returns:
        A result in the format of `evaluate_synthesis`, with the metrics of use.
    """
    generated = [without_void(scene) for scene in generated]
    if not generated:
        raise InputError("There are no scenes to evaluate; give at least one.")
    names = common_label_set(generated)
    if use.stand:
        generated = [make_stable(scene)[0] for scene in generated]
    sets: dict[str, Sequence[Scene]] = {"generated": generated}
    if shards is not None:
        every_train = reference_scenes(shards, "train")
        count = min(len(generated), len(every_train))
        sets["test"] = reference_scenes(shards, options.split)
        for name, make in (("shuffled", shuffled_rooms), ("independent", independent_rooms)):
            sets[name] = make(every_train, count, options.seed, with_meshes=True)
        common_label_set(generated, sets["test"])
    columns, left_out = measure_use(sets, options.seed, options.resamples, use)
    if scores is None:
        settings = {"seed": options.seed, "resamples": options.resamples, "intervals": METHOD}
        scores = {
            "format": FORMAT, "version": VERSION, "protocol": {"label_set": names, **settings}
        }  # fmt: skip
    result = merged(dict(scores), result_of(columns))
    floors = sum(scene.floor_m is not None for scene in generated)
    result["protocol"] = {
        **scores["protocol"],
        **{f"n_{name}": len(scenes) for name, scenes in sets.items()},
        "left_out": {**scores["protocol"].get("left_out", {}), **left_out},
        "use": {
            **{name: entry for metric in USE for name, entry in metric.protocol.items()},
            "settle": use.settle,
            "stand": use.stand,
            "n_with_floor": floors,
            "n_with_openings": sum(bool(scene.openings) for scene in generated),
        },
    }
    if 0 < floors < len(generated):
        note = (
            f"{len(generated) - floors} of {len(generated)} generated rooms have no floor, and are "
            "left out of the metrics that need one."
        )
        result["note"] = " ".join(filter(None, (note, scores.get("note"))))
    return result


def merged(first: dict[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Two nested results as one; values of the second replace those of the first."""
    for key, value in second.items():
        both = isinstance(value, Mapping) and isinstance(first.get(key), Mapping)
        first[key] = merged(dict(first[key]), value) if both else value
    return first
