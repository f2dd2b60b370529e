"""The sets of rooms that an evaluation compares: choosing, drawing and describing them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import Progress

from sceneprior.core.classes import VOID
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import (
    independent_rooms,
    known_in_3d,
    reference_scenes,
    shuffled_rooms,
    stream_scenes,
)
from sceneprior.core.scene import Scene
from sceneprior.evaluation.features import Drawing, Features
from sceneprior.evaluation.metric import RoomSet, resample_counts
from sceneprior.evaluation.metrics.contents import common_label_set
from sceneprior.evaluation.metrics.novelty import nearest_known


@dataclass(frozen=True)
class ChosenRooms:
    """The rooms to compare; only generated and decoded rooms keep their meshes."""

    groups: dict[str, Sequence[Scene]]
    """`test`, `generated`, `train`, `independent`, `shuffled` and, if any, `decoded_rooms`."""
    every_train: Sequence[Scene]
    val: Sequence[Scene]
    """The val rooms, which classifiers may train on; empty if `test` holds the val split."""
    train_rows: Sequence[int]
    """Indices into `every_train` of the rooms in `train`."""
    pictured_rows: Sequence[int]
    """Indices of the generated rooms that are drawn and compared by their pictures."""
    every_decoded: Sequence[Scene]
    split: str
    """The split that `test` holds, `test` or `val`."""
    seed: int


def choose_rooms(
    generated: Sequence[Scene], shards: Path, split: str, seed: int, decoded: Sequence[Scene]
) -> ChosenRooms:
    """Choose the rooms of every set; the arguments are those of `evaluate_synthesis`."""
    test = reference_scenes(shards, split, meshes=False)
    every_train = reference_scenes(shards, "train", meshes=False)
    generated = [without_void(scene) for scene in generated]
    common_label_set(generated, test)
    no_val = split == "val" or not known_in_3d(shards, "val")
    val = [] if no_val else reference_scenes(shards, "val", meshes=False)
    rows = seeded_rows(len(every_train), len(generated), seed)
    groups: dict[str, Sequence[Scene]] = {
        "test": test,
        "generated": generated,
        "train": [every_train[row] for row in rows],
    }
    for group, scenes in groups.items():
        if len(scenes) < 2:
            raise InputError(
                f"Scoring needs at least 2 {group} rooms, but there are {len(scenes)}; synthesize "
                "or prepare more."
            )
    groups["independent"] = independent_rooms(every_train, len(rows), seed)
    groups["shuffled"] = shuffled_rooms(every_train, len(rows), seed)
    if len(decoded) > 1:
        chosen = seeded_rows(len(decoded), len(rows), seed)
        groups["decoded_rooms"] = [decoded[row] for row in chosen]
    pictured = seeded_rows(len(generated), len(rows), seed)
    return ChosenRooms(groups, every_train, val, rows, pictured, decoded, split, seed)


def draw_rooms(
    rooms: ChosenRooms, shards: Path, drawing: Drawing, boxes: bool
) -> tuple[dict[str, Features], dict[str, Features]]:
    """Features of every group's pictures (and of `independent_meshes`), with meshes and as boxes.

    Frechet distances and recall depend on the number of pictures, so as many generated rooms are
    drawn as there are real training rooms.
    """
    pictured = [rooms.groups["generated"][row] for row in rooms.pictured_rows]
    groups, count = rooms.groups | {"generated": pictured}, len(rooms.train_rows)
    with Progress(console=Console(stderr=True)) as bars:

        def progress(group: str, total: int) -> Callable[[int], object]:
            return partial(bars.advance, bars.add_task(f"Drawing {group} rooms", total=total))

        def draw(title: str, scenes: Sequence[Scene]) -> Features:
            return drawing.features(scenes, progress(title, len(scenes)))

        def draw_real(split: str, rows: Sequence[int]) -> Features:
            return drawing.features(stream_scenes(shards, split, rows), progress(split, len(rows)))

        drawn = {
            "test": draw_real(rooms.split, range(len(groups["test"]))),
            "train": draw_real("train", rooms.train_rows),
        }
        for group in sorted(set(groups) - set(drawn)):
            drawn[group] = draw(group.replace("_", " "), groups[group])
        # Rooms are read again with meshes, so that all training meshes are in memory only here.
        furnished = independent_rooms(reference_scenes(shards, "train"), count, rooms.seed, True)
        drawn["independent_meshes"] = draw("independent, furnished", furnished)
        del furnished
        if not boxes:
            return drawn, {}
        as_boxes = {group: drawn[group] for group in ("independent", "shuffled")}  # boxes already
        for group in sorted(set(groups) - set(as_boxes)):
            plain = [scene.without_meshes() for scene in groups[group]]
            as_boxes[group] = draw(f"boxed {group}", plain)
    return drawn, as_boxes


def room_sets(
    rooms: ChosenRooms,
    drawn: dict[str, Features],
    as_boxes: dict[str, Features],
    resamples: int,
) -> dict[str, RoomSet]:
    """The sets of rooms by name, with `pictured`, the subset of generated rooms that is drawn."""
    sets: dict[str, RoomSet] = {}
    for number, (group, scenes) in enumerate(rooms.groups.items()):
        sets[group] = RoomSet(
            scenes,
            drawn[group],
            as_boxes.get(group),
            nearest_known(scenes, rooms.every_train, rooms.every_decoded, group == "train"),
            resample_counts(len(scenes), resamples, (rooms.seed, number)),
        )
    generated, rows = sets["generated"], rooms.pictured_rows
    sets["pictured"] = replace(
        generated,
        scenes=[generated.scenes[row] for row in rows],
        nearest=generated.nearest.of(rows),
        counts=resample_counts(len(rows), resamples, (rooms.seed, len(sets))),
    )
    sets["generated"] = replace(generated, pictures={}, box_pictures=None)
    pictures = drawn["independent_meshes"]
    sets["independent_meshes"] = replace(sets["independent"], pictures=pictures)
    return sets | {"train_rooms": sets["train"]}


def without_void(scene: Scene) -> Scene:
    """The scene without objects of class void."""
    known = zip(scene.objects, scene.class_indices, strict=True)
    return replace(scene, objects=tuple(item for item, index in known if index != VOID))


def seeded_rows(available: int, count: int, seed: int) -> list[int]:
    """At most `count` of `available` row indices, drawn without replacement, sorted."""
    if available <= count:
        return list(range(available))
    chosen = np.random.default_rng(seed).choice(available, size=count, replace=False)
    return sorted(chosen.tolist())
