"""Scores of completed rooms, compared with nearest training rooms and other baselines.

    python benchmarks/complete_rooms.py --run RUN --shards SHARDS [--answers 4] [--seed 0]

In each test room, half of the objects (rounded down, at least one), drawn by --seed, are given; the
others are hidden. The rows of the table are

- completed: results of `complete`, --answers per room;
- untouched start: the same without the fit (0 steps): the best sampled rooms, with the given
  objects inserted;
- nearest training room: the training room (its 3D ground truth, which training does not use) whose
  objects are nearest to the given objects of the same class, with the given objects inserted; one
  per room;
- test rooms: the test rooms themselves.

`overlaps` is the mean number of intersecting pairs of boxes, and `beds` the share of rooms with the
furniture of their type (a bed in bedrooms). `found` is the share of given objects for which the
room already had an object of the class, and `off_m` the mean distance between the two objects (over
centres and sides). `differ` is the diversity of a room's completions, a mean over pairs of
completions. Added objects of the same class are matched, and a pair scores 1 minus the summed IoU
of the matches divided by the larger number of added objects; 0 means equal.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import torch

from sceneprior.apps.config import load_run
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.overlaps import match_scenes
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metric import object_count
from sceneprior.evaluation.metrics.contents import (
    category_kl,
    class_frequencies,
    type_share,
)
from sceneprior.evaluation.metrics.overlaps import room_overlaps
from sceneprior.lifted.complete import STEPS, complete
from sceneprior.lifted.insert import insert


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--run", type=Path, required=True)
    parser.add_argument("--shards", type=Path, required=True)
    parser.add_argument("--answers", type=int, default=4)
    parser.add_argument("--rooms", type=int, help="number of test rooms (default: all)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    trained = load_run(arguments.run)
    trained = replace(trained, stage="layout")  # boxes are compared; meshes would take time
    most = trained.config.model.max_objects
    rooms = reference_scenes(arguments.shards, "test", arguments.rooms)
    tests = [without_meshes(room) for room in rooms if 2 <= len(room.objects) <= most]
    training = [without_meshes(room) for room in reference_scenes(arguments.shards, "train")]
    rng = np.random.default_rng(arguments.seed)
    given = [half(room, rng) for room in tests]

    def completed(steps: int) -> list[list[Scene]]:
        return complete(trained, given, arguments.answers, arguments.seed, steps=steps)

    rows = {
        "completed": completed(STEPS),
        "untouched start": completed(0),
        "nearest training room": [[insert(nearest(training, one), one)] for one in given],
        "test rooms": [[room] for room in tests],
    }
    scores = {name: evaluate(answers, tests, given) for name, answers in rows.items()}
    columns = list(next(iter(scores.values())))
    print(f"{len(tests)} test rooms, {arguments.answers} answers each, seed {arguments.seed}")
    print("| rooms | " + " | ".join(columns) + " |\n|" + " --- |" * (len(columns) + 1))
    for name, row in scores.items():
        print(f"| {name} | " + " | ".join(str(value) for value in row.values()) + " |")
    if arguments.json:
        arguments.json.write_text(json.dumps(scores, indent=1) + "\n")


def without_meshes(room: Scene) -> Scene:
    return replace(room.without_meshes(), extra={})


def half(room: Scene, rng: np.random.Generator) -> Scene:
    """A room with half of its objects, rounded down, at least one."""
    count = max(1, len(room.objects) // 2)
    rows = sorted(rng.permutation(len(room.objects))[:count])
    return replace(room, objects=tuple(room.objects[row] for row in rows))


def nearest(training: Sequence[Scene], given: Scene) -> Scene:
    """The training room with the smallest mean difference of centres and sides from the given
    objects.

    A missing object costs 2 m.
    """

    def cost(room: Scene) -> float:
        total = 0.0
        for label in {item.label for item in given.objects}:
            ours, theirs = (of_class(scene, label) for scene in (room, given))
            match = match_scenes(ours, theirs)
            boxes, wanted = (np.hstack([s.centers_m, s.sizes_m]) for s in (ours, theirs))
            apart = np.abs(boxes[match.decoded] - wanted[match.truth]).mean(axis=1)
            total += float(apart.sum()) + 2.0 * (len(theirs.objects) - len(apart))
        return total

    return min(training, key=cost)


def of_class(scene: Scene, label: str) -> Scene:
    return replace(scene, objects=tuple(item for item in scene.objects if item.label == label))


def evaluate(
    answers: list[list[Scene]], tests: list[Scene], given: Sequence[Scene]
) -> dict[str, float | str]:
    every = [scene for scenes in answers for scene in scenes]
    marked = [scene.extra for scene in every if scene.extra]
    asked = sum(len(extra["given"]) for extra in marked)
    off = [extra["replaced_off_m"] for extra in marked if extra["replaced"]]
    apart = [
        difference(*(replace(s, objects=s.objects[len(one.objects) :]) for s in pair))
        for scenes, one in zip(answers, given, strict=True)
        for pair in combinations(scenes, 2)
    ]
    return {
        "category_kl": round(category_kl(class_frequencies(tests), class_frequencies(every)), 3),
        "overlaps": round(float(np.mean([room_overlaps(s).intersect.sum() for s in every])), 2),
        "beds": round(type_share(every) or 0.0, 3),
        "objects": round(float(np.mean([object_count(room) for room in every])), 2),
        "found": round(sum(extra["replaced"] for extra in marked) / asked, 2) if marked else "-",
        "off_m": round(float(np.mean(off)), 2) if off else "-",
        "differ": round(float(np.mean(apart)), 2) if apart else "-",
    }


def difference(a: Scene, b: Scene) -> float:
    match = match_scenes(a, b)
    most = max(len(a.objects), len(b.objects))
    return 1 - float((match.iou * match.correct).sum()) / most if most else 0.0


if __name__ == "__main__":
    main()
