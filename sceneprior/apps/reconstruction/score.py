"""Score reconstructions from single views against the true rooms, and print the scores."""

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.table import Table

from sceneprior.apps.config import load_any_run
from sceneprior.apps.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.apps.retrieval.cad_models import open_models
from sceneprior.apps.retrieval.retrieve import retrieve_all
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import models_of, reference_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.shards import iterate_rooms
from sceneprior.core.views import ObservedImage, image_of_room, images_of_split
from sceneprior.evaluation.score_table import wide_console
from sceneprior.evaluation.view_scores import (
    POINTS,
    PROTOCOL,
    score_views,
    surface_note,
)
from sceneprior.lifted.reconstruction.known_rooms import (
    known_rooms,
    nearest_answers,
    random_answers,
)
from sceneprior.render.offscreen import SoftwareRenderer
from sceneprior.render.scene_files import load_scene_folder

TITLES = {
    "scenes": "given scenes",
    "scenes_boxes": "the same, as boxes",
    "fit": "fitted",
    "fit_boxes": "the same, as boxes",
    "fit_cad": "the same, with CAD models",
    "layout_fit": "fitted to 2D boxes alone, as boxes",
    "nearest_room": "nearest training room",
    "random_room": "random training room",
}
COLUMNS = {
    "box_iou_3d": ("3D box IoU", "{:.3f}"),
    "oriented_box_iou_3d": ("oriented", "{:.3f}"),
    "chamfer_l2_m": ("CD L2, m", "{:.3f}"),
    "chamfer_squared_m2": ("CD squared, m2", "{:.3f}"),
    "f_score": ("F at 5 cm", "{:.3f}"),
    "class_accuracy": ("class", "{:.2f}"),
}

Answers = Sequence[Sequence[SceneObject | None]]
"""Reconstructed objects by image and mask; None for a mask without an object."""


def evaluate_run(
    run: str,
    shards: Path,
    options: FitOptions,
    split: str = "test",
    seed: int = 0,
    count: int = 1,
    limit: int | None = None,
    models: Path | None = None,
) -> dict[str, Any]:
    """Reconstruct views of the rooms of a split and score them against their 3D ground truth.

    With CAD `models`, the reconstructions are also scored with the objects replaced by retrieved
    models (apps/retrieval).

    Args:
        seed: Seed of the views and of the random training rooms.
        count: Number of views drawn from each room; all if a room has fewer.
        limit: Number of rooms; None takes all.
    """
    trained = load_any_run(run)
    reference_scenes(shards, split, limit=1, meshes=False)  # raises before any fit
    images, blank = images_of_split(shards, split, seed, limit, count)
    begin = time.process_time()
    fitted = reconstruct(trained, images, options)
    seconds = time.process_time() - begin
    answers: dict[str, Answers] = {
        "fit": [one.scene.objects for one in fitted],
        "fit_boxes": [one.scene.without_meshes().objects for one in fitted],
    }
    if models is not None:
        cad_models = open_models(models, trained.config.label_set)
        retrieved = retrieve_all([one.scene for one in fitted], cad_models)
        answers["fit_cad"] = [scene.objects for scene in retrieved]
    overlaps = [one.mask_iou for one in fitted if one.mask_iou is not None]
    if overlaps:
        plain = reconstruct(trained, images, replace(options, masks=False))
        answers["layout_fit"] = [one.scene.without_meshes().objects for one in plain]
    return {
        "rows": score_answers(images, answers, shards, split, seed),
        "mask_iou": sum(overlaps) / len(overlaps) if overlaps else None,
        "cpu_seconds_an_image": seconds / len(images),
        "protocol": {
            "run": Path(run).resolve().name,
            "stage": trained.stage,
            "views": "drawn at random from those that show an object",
            "views_per_room": count,
            "rooms_without_such_a_view": blank,
            "fit": asdict(options),
            "models": None if models is None else Path(models).resolve().name,
            **_protocol(images, shards, split, seed),
        },
    }


def evaluate_scenes(
    folder: Path, shards: Path, split: str = "test", seed: int = 0
) -> dict[str, Any]:
    """Score a folder of reconstructions, as written by `reconstruct` or by `retrieve` after it.

    Each scene's `extra` holds its `room_id` and `view`; its objects correspond to the masks of that
    view, in their order.
    """
    images, scenes = scenes_with_images(folder, shards, split)
    answers: dict[str, Answers] = {
        "scenes": [scene.objects for scene in scenes],
        "scenes_boxes": [scene.without_meshes().objects for scene in scenes],
    }
    return {
        "rows": score_answers(images, answers, shards, split, seed),
        "protocol": {
            "scenes": str(folder),
            "views": {image.name: image.view for image in images},
            **_protocol(images, shards, split, seed),
        },
    }


def scenes_with_images(
    folder: Path, shards: Path, split: str
) -> tuple[list[ObservedImage], list[Scene]]:
    """The scenes of a folder, each with its input view; see `evaluate_scenes`."""
    of_room: dict[str, list[Scene]] = defaultdict(list)
    for scene in load_scene_folder(folder):
        room = scene.extra.get("room_id")
        if not isinstance(room, str) or not room or not isinstance(scene.extra.get("view"), int):
            raise InputError(
                f"Scene '{scene.name}' of {folder} does not say which image it reconstructs: its "
                "'extra' needs a 'room_id' of the shards and a 'view', as written by `sceneprior "
                "reconstruct --shards`."
            )
        of_room[room].append(scene)
    images, scenes = [], []
    for shard, room in iterate_rooms(shards, split):
        for scene in of_room.pop(room, []):
            seen = shard.read_room(room, images=True)
            image = image_of_room(seen, scene.extra["view"], shard.label_set)
            if len(scene.objects) != len(image.rows):
                raise InputError(
                    f"Scene '{scene.name}' of {folder} has {len(scene.objects)} objects, but view "
                    f"{image.view} of room {room} shows {len(image.rows)}; a reconstruction has "
                    "one object per mask, in the masks' order."
                )
            images.append(image)
            scenes.append(scene)
    if of_room:
        raise InputError(
            f"The '{split}' split of {shards} has no room {', '.join(sorted(of_room)[:3])}, but "
            f"{folder} has scenes of it; name the split or the shards that the scenes come from."
        )
    return images, scenes


def _protocol(
    images: Sequence[ObservedImage], shards: Path, split: str, seed: int
) -> dict[str, Any]:
    """The settings of a result file that scores of runs and of scenes share."""
    return {
        "known_model_share": known_model_share(images, shards, split),
        "shards": str(shards),
        "split": split,
        "seed": seed,
        "points": POINTS,
        **PROTOCOL,
    }


def score_answers(
    images: Sequence[ObservedImage],
    answers: dict[str, Answers],
    shards: Path,
    split: str,
    seed: int,
) -> dict[str, Any]:
    """Scores by row: rows of the given reconstructions, and baseline rows of training rooms."""
    rooms = known_rooms(shards)
    nearest = nearest_answers(rooms, images, SoftwareRenderer())
    drawn = random_answers(rooms, images, seed)
    answers = {
        **answers,
        "nearest_room": [one.objects for one in nearest],
        "random_room": [one.objects for one in drawn],
    }
    true_rooms = reference_scenes(shards, split, tracked_only=True)
    truth = {scene.name: scene.objects for scene in true_rooms}
    rows = {}
    for name, some in answers.items():
        views = []
        for image, objects in zip(images, some, strict=True):
            shown = [truth[image.room_id][row] for row in image.rows]
            views.append([*zip(shown, objects, strict=True)])
        rows[name] = score_views(views, [image.room_id for image in images])
    return rows


def known_model_share(images: Sequence[ObservedImage], shards: Path, split: str) -> float | None:
    """Share of the objects in images whose CAD model also occurs in a training room.

    None if no model is known. If it is near 1, the scores do not measure unseen furniture.
    """
    known = {model_id for models in models_of(shards, "train").values() for model_id in models}
    models = models_of(shards, split)
    shown = [models[image.room_id][row] for image in images for row in image.rows]
    named = [model_id in known for model_id in shown if model_id]
    return sum(named) / len(named) if named else None


def print_view_scores(scores: dict[str, Any]) -> None:
    """Print both tables of a result: all objects by method, and the first method by class."""
    rows = {
        TITLES[name]: {**row["summary"], "intervals": row["intervals"]}
        for name, row in scores["rows"].items()
    }
    evaluated = next(iter(scores["rows"].values()))
    summary = evaluated["summary"]
    tables = {
        f"{summary['objects']} objects in {summary['images']} single views of {summary['rooms']} "
        "rooms, with 95% intervals over rooms": rows,
        f"{next(iter(rows)).capitalize()}, by class": evaluated["classes"],
    }
    console = wide_console()
    for title, lines in tables.items():
        table = Table("", "objects", "unmatched", "with a surface", title=title)
        for name, _ in COLUMNS.values():
            table.add_column(name, justify="right")
        for label, row in lines.items():
            cells = (_cell(row, key, form) for key, (_, form) in COLUMNS.items())
            counts = (str(row[key]) for key in ("objects", "unmatched", "with_surface"))
            table.add_row(label, *counts, *cells)
        console.print(table)
    shards = scores["protocol"]["shards"]
    if note := surface_note(summary["objects"], summary["with_surface"], shards):
        console.print(f"Note: {note}", highlight=False)


def _cell(row: dict[str, Any], key: str, form: str) -> str:
    if row[key] is None:
        return "–"
    ends = row.get("intervals", {}).get(key)
    return form.format(row[key]) + (f"\n{form} to {form}".format(*ends) if ends else "")
