"""Score reconstructions from single views against the true rooms, and print the scores."""

from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Table

from sceneprior.apps.api import load
from sceneprior.apps.reconstruction.reconstruct import reconstruct
from sceneprior.apps.retrieval.cad_models import open_models
from sceneprior.apps.retrieval.retrieve import retrieve_all
from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import models_of, reference_scenes
from sceneprior.core.parallel import map_blocks
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
from sceneprior.lifted.reconstruction.known_rooms import KnownRooms
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

BLOCK = 16
"""Images that a task compares with all training rooms."""
Answers = Sequence[Sequence[SceneObject | None]]
"""Reconstructed objects by image and mask; None for a mask without an object."""


def evaluate_run(
    run: str,
    shards: Path,
    fit: str,
    restarts: int,
    split: str,
    seed: int,
    count: int,
    limit: int | None,
    models: Path | None,
) -> dict[str, Any]:
    """Reconstruct views of the rooms of a split and score them against their 3D ground truth.

    With CAD `models`, the reconstructions are also scored with the objects replaced by retrieved
    models (apps/retrieval).

    Args:
        seed: Seed of the views and of the random training rooms.
        count: Number of views drawn from each room; all if a room has fewer.
        limit: Number of rooms; None takes all.
    """
    prior = load(run)
    reference_scenes(shards, split, limit=1, meshes=False)  # raises before any fit
    images, blank = images_of_split(shards, split, seed, limit, count)
    fitted = reconstruct(prior, images, fit, restarts)
    answers: dict[str, Answers] = {
        "fit": [one.scene.objects for one in fitted],
        "fit_boxes": [one.scene.without_meshes().objects for one in fitted],
    }
    if models is not None:
        cad_models = open_models(models, prior.label_set)
        retrieved = retrieve_all([one.scene for one in fitted], cad_models)
        answers["fit_cad"] = [scene.objects for scene in retrieved]
    overlaps = [one.mask_iou for one in fitted if one.mask_iou is not None]
    if overlaps:
        plain = reconstruct(prior, images, fit, restarts, masks=False)
        answers["layout_fit"] = [one.scene.without_meshes().objects for one in plain]
    protocol = {
        "run": Path(run).resolve().name,
        "stage": prior.trained.stage,
        "views": "drawn at random from those that show an object",
        "views_per_room": count,
        "rooms_without_such_a_view": blank,
        "fit": {"fit": fit, "restarts": restarts, "masks": True},
        "models": None if models is None else Path(models).resolve().name,
    }
    more = {
        "mask_iou": sum(overlaps) / len(overlaps) if overlaps else None,
        "cpu_seconds_an_image": sum(one.cpu_s for one in fitted) / len(images),
    }
    return _scored(images, answers, shards, split, seed, protocol, more)


def evaluate_scenes(folder: Path, shards: Path, split: str, seed: int) -> dict[str, Any]:
    """Score a folder of reconstructions, as written by `reconstruct` or by `retrieve` after it.

    Each scene's `extra` holds its `room_id` and `view`; its objects correspond to the masks of that
    view, in their order.
    """
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
    answers: dict[str, Answers] = {
        "scenes": [scene.objects for scene in scenes],
        "scenes_boxes": [scene.without_meshes().objects for scene in scenes],
    }
    protocol = {"scenes": str(folder), "views": {image.name: image.view for image in images}}
    return _scored(images, answers, shards, split, seed, protocol, {})


def _scored(
    images: Sequence[ObservedImage],
    answers: dict[str, Answers],
    shards: Path,
    split: str,
    seed: int,
    protocol: dict[str, Any],
    more: dict[str, Any],
) -> dict[str, Any]:
    """A result file: scores by row, of the given reconstructions and of training rooms as
    baselines, and the settings."""
    rooms, rng = KnownRooms(shards), np.random.default_rng(seed)
    nearest = partial(_nearest_rooms, rooms)
    answers = {
        **answers,
        "nearest_room": map_blocks(nearest, images, BLOCK, "comparing training rooms"),
        "random_room": [rooms.drawn(image, rng).objects for image in images],
    }
    true_rooms = reference_scenes(shards, split, tracked_only=True)
    truth = {scene.name: scene.objects for scene in true_rooms}
    shown = [[truth[image.room_id][row] for row in image.rows] for image in images]
    room_ids = [image.room_id for image in images]
    rows = {}
    for name, some in answers.items():
        views = [[*zip(*pair, strict=True)] for pair in zip(shown, some, strict=True)]
        rows[name] = score_views(views, room_ids)
    # The share of the objects whose CAD model also occurs in a training room; None if no model is
    # known. If it is near 1, the scores do not measure unseen furniture.
    known = {model_id for models in models_of(shards, "train").values() for model_id in models}
    models = models_of(shards, split)
    named = [models[image.room_id][row] for image in images for row in image.rows]
    is_known = [model_id in known for model_id in named if model_id]
    protocol |= {
        "known_model_share": sum(is_known) / len(is_known) if is_known else None,
        "shards": str(shards),
        "split": split,
        "seed": seed,
        "points": POINTS,
        **PROTOCOL,
    }
    return {"rows": rows, **more, "protocol": protocol}


def _nearest_rooms(rooms: KnownRooms, images: Sequence[ObservedImage], first: int) -> list[Any]:
    renderer = SoftwareRenderer()
    return [rooms.nearest(image, renderer).objects for image in images]


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
