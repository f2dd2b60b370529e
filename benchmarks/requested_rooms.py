"""Rooms sampled for requests that are made from test rooms: fulfilled wishes, plausibility, time.

    python benchmarks/requested_rooms.py --run procthor-bedroom --shards SHARDS [--doors] [--seed 0]

Each request has the floor of a test room, half of the room's objects (rounded up) as the minimum
number of each class, and two relations of `sceneprior/lifted/requests/relations.py`, drawn by
--seed from those that hold between these objects. So the test room itself meets the request. Fronts
are those of the ground truth; objects of a class without a front have no relations that need a
front. With --doors, a request also has a door and a window at random places. One room is sampled
for each request. Test rooms are reused with other halves until there are --requests requests.
Objects of classes that the prior does not draw are ignored.

`met` is the number of fulfilled counts and relations. `classifier` is the accuracy of the layout
classifier (docs/evaluation.md) between requested and real rooms, and `unconditioned` its accuracy
between equally many rooms without a request and real rooms; 0.5 is best. `seconds` is the CPU time
per room, including meshes, after one room to warm up.
"""

import argparse
import json
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch

import sceneprior
from sceneprior.apps.api import Prior
from sceneprior.core.classes import VOID
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shards import iterate_rooms
from sceneprior.evaluation.metric import Comparison, RoomSet
from sceneprior.evaluation.metrics.layouts import layout_classifier_accuracy
from sceneprior.lifted.requests.floors import Floor, RoomShape
from sceneprior.lifted.requests.relations import OUTWARD, Furniture, RelationChecks
from sceneprior.lifted.requests.wishes import TO_ROOM, TO_TARGET, RelationWish, meant_relation

RELATIONS = 2
"""Number of relations per request."""
BY_FRONT_OF_TARGET = (
    "beside", "on both sides of", "at the foot of", "opposite", "in front of",
)  # fmt: skip
BY_FRONT_OF_SUBJECT = ("facing", "at", "opposite", "back to a wall", "with a free front")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--run", required=True)
    parser.add_argument("--shards", type=Path, required=True)
    parser.add_argument("--requests", type=int, default=200)
    parser.add_argument("--doors", action="store_true", help="add a door and a window")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    prior = sceneprior.load(arguments.run)
    test = reference_scenes(arguments.shards, "test", meshes=False)
    fronts = fronts_of(arguments.shards, "test")
    real = [
        scene
        for split in ("train", "val")
        for scene in reference_scenes(arguments.shards, split, meshes=False)
    ]
    rng = np.random.default_rng(arguments.seed)
    requests = requests_of(prior, test, fronts, arguments.requests, arguments.doors, rng)
    prior.sample(1, seed=0, floor="4x4")
    rooms, refused = [], []
    start = time.process_time()
    for number, request in enumerate(requests):
        try:
            rooms += prior.sample(1, seed=arguments.seed + number, **request)
        except InputError as error:
            refused.append(str(error))
    seconds = (time.process_time() - start) / len(requests)
    held = [each["holds"] for room in rooms for each in room.extra["wishes"]]
    unmet = Counter(
        each["wish"] for room in rooms for each in room.extra["wishes"] if not each["holds"]
    )
    relations = Counter(each["relation"] for r in requests for each in r["want"]["relations"])
    plain = prior.sample(len(rooms), seed=arguments.seed)
    result = {
        "requests": len(requests), "refused": refused, "wishes": len(held), "met": sum(held),
        "relations": dict(relations),
        "unmet": dict(unmet), "seconds": round(seconds, 3),
        "classifier": accuracy(rooms, real, test, arguments.seed),
        "unconditioned": accuracy(plain, real, test, arguments.seed),
    }  # fmt: skip
    print(json.dumps(result, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(result, indent=1) + "\n")


def has_front(label: str) -> bool:
    """True for classes with a front: all but lamps, tables and stools."""
    words = ("lamp", "table", "stool")
    return label == "dressing_table" or not any(word in label for word in words)


def fronts_of(shards: Path, split: str) -> list[np.ndarray]:
    """The true front side of each object of `reference_scenes`, numbered as in `Furniture`."""
    fronts = []
    for shard, room_id in iterate_rooms(shards, split):
        truth = shard.read_ground_truth(room_id)
        yaw_rad = truth.yaw_rad[truth.object_class != VOID]
        ahead = np.stack([np.sin(yaw_rad), np.cos(yaw_rad)], axis=1)
        fronts.append((ahead @ OUTWARD.T).argmax(axis=1))
    return fronts


def requests_of(
    prior: Prior,
    test: Sequence[Scene],
    fronts: Sequence[np.ndarray],
    count: int,
    doors: bool,
    rng: np.random.Generator,
) -> list[dict[str, Any]]:
    """Arguments of `Prior.sample` for requests made from test rooms with the given fronts of
    objects."""
    trained: Any = prior.trained
    known = {prior.classes[row] for row in trained.sampler.drawn_classes}
    requests: list[dict[str, Any]] = []
    for number in range(20 * count):
        room = test[number % len(test)]
        objects = [row for row, item in enumerate(room.objects) if item.label in known]
        if len(objects) < 2 or room.floor_m is None:
            continue
        rows = rng.permutation(objects)[: (len(objects) + 1) // 2]
        half = [room.objects[row] for row in rows]
        front = fronts[number % len(test)][rows]
        found = relations_of(room.floor_m, half, front, prior.classes)
        relations = [found[row] for row in rng.permutation(len(found))[:RELATIONS]]
        counts = Counter(item.label for item in half)
        want: dict[str, Any] = {label: f">={times}" for label, times in counts.items()}
        want["relations"] = [
            {
                "subject": wish.subject,
                "relation": wish.relation,
                "target": wish.target,
                "count": wish.count,
            }
            for wish in relations
        ]
        request = {"floor": room.floor_m, "want": want}
        requests.append(request | ({"openings": "door,window"} if doors else {}))
        if len(requests) == count:
            break
    return requests


def relations_of(
    floor_m: np.ndarray, half: Sequence[SceneObject], front: np.ndarray, classes: tuple[str, ...]
) -> list[RelationWish]:
    """Relations that hold between the given objects in their room."""
    labels = sorted({item.label for item in half})
    wishes = [
        RelationWish(label, relation)
        for label in labels
        for relation in TO_ROOM
        if has_front(label) or relation not in BY_FRONT_OF_SUBJECT
    ]
    wishes += [
        meant_relation(label, relation, other, 1)
        for label in labels
        for other in labels
        if label != other
        for relation in TO_TARGET
        if has_front(other) or relation not in BY_FRONT_OF_TARGET
        if has_front(label) or relation not in BY_FRONT_OF_SUBJECT
    ]
    furniture = Furniture(
        np.array([[*item.center_m, *item.size_m] for item in half]),
        np.array([classes.index(item.label) for item in half]),
        np.zeros(len(half), dtype=np.int64),  # backs, which relations do not read
        OUTWARD[front],
    )
    held = RelationChecks(wishes, RoomShape(Floor(floor_m)), classes).held(furniture)
    return [wish for wish, holds in zip(wishes, held, strict=True) if holds]


def accuracy(
    rooms: Sequence[Scene], real: Sequence[Scene], test: Sequence[Scene], seed: int
) -> float:
    """`layout_classifier_accuracy` of a set of rooms, without an interval."""
    # The metric reads no pictures and no nearest rooms.
    own, others = (
        cast(RoomSet, SimpleNamespace(scenes=scenes, counts=np.ones((1, len(scenes)), dtype=int)))
        for scenes in (rooms, test)
    )
    compared = cast(
        Comparison,
        SimpleNamespace(
            test=others, train=real, val=[], seed=seed, is_training_set=lambda rooms: False
        ),
    )
    found = layout_classifier_accuracy(own, compared)
    assert found.value is not None
    return round(found.value, 3)


if __name__ == "__main__":
    main()
