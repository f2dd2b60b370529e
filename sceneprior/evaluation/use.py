"""Metrics of use, which test whether rooms suit simulation: collisions, support, free floor, doors,
volumes, stability."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from sceneprior.core.contact_resolution import make_stable
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import independent_rooms, reference_scenes, shuffled_rooms
from sceneprior.core.parallel import run_tasks
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import METHOD, Counts, Estimate, ratio, resample_counts
from sceneprior.evaluation.metrics import USE
from sceneprior.evaluation.metrics.contents import common_label_set, without_void
from sceneprior.evaluation.metrics.physics import stable_count
from sceneprior.evaluation.synthesis import FORMAT, VERSION, EvalOptions, kept, result_of

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
    sets: Mapping[str, Sequence[Scene]],
    seed: int,
    resamples: int,
    options: UseOptions,
    shards: Path | None = None,
) -> tuple[dict[str, dict[str, Estimate]], dict[str, str]]:
    """Compute all metrics of use for sets of rooms, with intervals over rooms; measurements of all
    sets but `generated` are `kept`.

    Returns:
        The metrics by set and key; and the metrics that are left out of all sets, each with what
        no generated room has (a floor, doors or windows).
    """
    columns: dict[str, dict[str, Estimate]] = {}
    for number, (name, scenes) in enumerate(sets.items()):
        rooms = {f"room {row} of {name}": (scene, options) for row, scene in enumerate(scenes)}
        measure = partial(run_tasks, measure_room, rooms, f"measuring {name} rooms")
        key = name, seed, options, tuple(scene.name for scene in scenes)
        measured = measure() if name == "generated" else kept(shards, key, measure)
        # These seeds are far from those of `evaluate_synthesis`.
        counts = resample_counts(len(scenes), resamples, (seed, 100 + number))
        columns[name] = {}
        for metric in USE:
            pairs = [room.get(metric.key, (0.0, 0.0)) for room in measured]
            sums, numbers = np.array(pairs, dtype=float).reshape(-1, 2).T
            high = np.inf if metric.key.endswith("litres") else 1.0
            columns[name][metric.key] = ratio(sums, numbers, counts, high)
    left_out = {}
    for metric in USE:
        if columns["generated"][metric.key].value is None:
            left_out[metric.key] = metric.needs
            if metric.function is stable_count:
                if options.settle == "none":
                    left_out[metric.key] = "--settle solids"
                elif find_spec("mujoco") is None:
                    left_out[metric.key] = "mujoco (pip install 'sceneprior[sim]')"
            elif not any(scene.objects for scene in sets["generated"]):
                left_out[metric.key] = "objects in the scenes"
            for found in columns.values():
                del found[metric.key]
    return columns, left_out


def measure_room(scene: Scene, options: UseOptions) -> Counts:
    """Numerators and denominators of all metrics of use, for one room."""
    found: dict[str, tuple[float | int, float | int]] = {}
    ready = options.settle == "all" or all(o.solids or o.mesh is None for o in scene.objects)
    simulated = ready and options.settle != "none" and find_spec("mujoco") is not None
    for function in dict.fromkeys(metric.function for metric in USE):
        if simulated or function is not stable_count:
            found |= function(scene)
    return found


def evaluate_use(
    generated: Sequence[Scene],
    options: EvalOptions,
    use: UseOptions,
    shards: Path | None,
    scores: Mapping[str, Any] | None,
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
    notes = list[str]()
    if use.stand:
        tasks = {f"room {row}": (scene,) for row, scene in enumerate(generated)}
        stable = run_tasks(make_stable, tasks, "settling rooms")
        generated = [each.scene for each in stable]
        notes += [said for each in stable for said in each.left_out]
    sets: dict[str, Sequence[Scene]] = {"generated": generated}
    if shards is not None:
        train = reference_scenes(shards, "train")
        count = min(len(generated), len(train))
        sets["test"] = reference_scenes(shards, options.split)
        sets["shuffled"] = shuffled_rooms(train, count, options.seed)
        sets["independent"] = independent_rooms(train, count, options.seed)
        common_label_set(generated, sets["test"])
    columns, left_out = measure_use(sets, options.seed, options.resamples, use, shards)
    if scores is None:
        settings = {"seed": options.seed, "resamples": options.resamples, "intervals": METHOD}
        scores = {
            "format": FORMAT, "version": VERSION, "protocol": {"label_set": names, **settings}
        }  # fmt: skip
        if shards is not None:
            scores["protocol"] |= {"shards": Path(shards).resolve().name, "split": options.split}
    result = _merged(scores, result_of(columns))
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
        notes.append(
            f"{len(generated) - floors} of {len(generated)} generated rooms have no floor, and are "
            "left out of the metrics that need one."
        )
    if notes:
        result["note"] = " ".join(filter(None, (*notes, scores.get("note"))))
    return result


def _merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Two nested results as one; values of the second replace those of the first."""
    both = {key for key in second if isinstance(first.get(key), Mapping)}
    return {**first, **second} | {key: _merged(first[key], second[key]) for key in both}
