"""Score reconstructions from single views against the true rooms, and print the scores."""

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from sceneprior.config import load_any_run
from sceneprior.errors import InputError
from sceneprior.evaluation.ground_truth import reference_scenes
from sceneprior.evaluation.metrics.mesh_metrics import POINTS
from sceneprior.evaluation.score_table import wide_console
from sceneprior.evaluation.view_scores import PROTOCOL, ObjectPair, score_views, surface_note
from sceneprior.generation.cad_models import default_cache, open_models
from sceneprior.generation.retrieve import retrieve_all
from sceneprior.offscreen import open_renderer
from sceneprior.reconstruction.image import ObservedImage, image_of_room, images_of_split
from sceneprior.reconstruction.known_rooms import known_rooms, nearest_answers, random_answers
from sceneprior.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.scene import Scene, SceneObject
from sceneprior.scene_files import load_scene_folder
from sceneprior.shards import iterate_rooms

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
"""For each image, one object a mask; None where there is none."""


@dataclass(frozen=True)
class SvrProtocol:
    """What single-view reconstructions are scored against, and how."""

    shards: Path
    """With 3D ground truth; `train` is where known rooms come from."""
    split: str = "test"
    """Whose rooms are reconstructed."""
    seed: int = 0
    """Of the random known rooms, and of the views where a run is evaluated."""
    renderer: str = "auto"
    points: int = POINTS
    """Drawn from each surface."""

    def as_dict(self) -> dict[str, Any]:
        """As it stands in a result file."""
        told = {"shards": str(self.shards), "split": self.split, "points": self.points}
        return {**told, **PROTOCOL}


def evaluate_run(
    run: str,
    protocol: SvrProtocol,
    options: FitOptions,
    limit: int | None = None,
    checkpoint: str = "final",
    models: Path | None = None,
) -> dict[str, Any]:
    """Reconstruct one view of each room (or the first `limit`) and score it against the truth; of
    CAD `models`, too, one in the place of each object (`generation.retrieve`).

    Raises:
        InputError: the run or the shards cannot be used.
    """
    trained = load_any_run(run, checkpoint)
    shards, split = protocol.shards, protocol.split
    reference_scenes(shards, split, limit=1, meshes=False)  # refuses before any fit
    images, blank = images_of_split(shards, split, protocol.seed, limit)
    begin = time.process_time()
    fitted = reconstruct(trained, images, options)
    seconds = time.process_time() - begin
    answers: dict[str, Answers] = {
        "fit": [one.scene.objects for one in fitted],
        "fit_boxes": [one.scene.without_meshes().objects for one in fitted],
    }
    if models is not None:
        cad_models = open_models(models, trained.config.label_set, default_cache())
        retrieved = retrieve_all([one.scene for one in fitted], cad_models)
        answers["fit_cad"] = [scene.objects for scene in retrieved]
    overlaps = [one.mask_iou for one in fitted if one.mask_iou is not None]
    if overlaps:
        plain = reconstruct(trained, images, replace(options, masks=False))
        answers["layout_fit"] = [one.scene.without_meshes().objects for one in plain]
    return {
        "rows": score_answers(images, answers, protocol),
        "mask_iou": sum(overlaps) / len(overlaps) if overlaps else None,
        "cpu_seconds_an_image": seconds / len(images),
        "protocol": {
            "run": Path(run).resolve().name,
            "checkpoint": checkpoint,
            "stage": trained.stage,
            "views": "one a room, drawn at random from those that show an object",
            "rooms_without_such_a_view": blank,
            "fit": asdict(options),
            "models": None if models is None else Path(models).resolve().name,
            **protocol.as_dict(),
        },
    }


def evaluate_scenes(folder: Path, protocol: SvrProtocol) -> dict[str, Any]:
    """Score a folder of reconstructions: as `reconstruct` wrote them, or with CAD models since.

    Each scene's `extra` names its `room_id` and `view`; its objects are one a mask of that view, in
    the masks' order.

    Raises:
        InputError: a scene does not say which view it answers, or has another number of objects.
        ShardError: a shard is missing or damaged.
    """
    images, scenes = scenes_with_images(folder, protocol.shards, protocol.split)
    answers: dict[str, Answers] = {
        "scenes": [scene.objects for scene in scenes],
        "scenes_boxes": [scene.without_meshes().objects for scene in scenes],
    }
    return {
        "rows": score_answers(images, answers, protocol),
        "protocol": {
            "scenes": str(folder),
            "views": {image.room_id: image.view for image in images},
            "seed": protocol.seed,
            **protocol.as_dict(),
        },
    }


def scenes_with_images(
    folder: Path, shards: Path, split: str
) -> tuple[list[ObservedImage], list[Scene]]:
    """The scenes of a folder, each with the view that it answers; see `evaluate_scenes`."""
    of_room: dict[str, list[Scene]] = defaultdict(list)
    for scene in load_scene_folder(folder):
        room = scene.extra.get("room_id")
        if not isinstance(room, str) or not room or not isinstance(scene.extra.get("view"), int):
            raise InputError(
                f"Scene '{scene.name}' of {folder} does not say which image it answers: its "
                "'extra' needs a 'room_id' of the shards and a 'view', as `sceneprior reconstruct "
                "--shards` writes them."
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
                    "one object a mask, in the masks' order."
                )
            images.append(image)
            scenes.append(scene)
    if of_room:
        raise InputError(
            f"The '{split}' split of {shards} has no room {', '.join(sorted(of_room)[:3])}, which "
            f"scenes of {folder} are of; name the split, or the shards, they were made from."
        )
    return images, scenes


def score_answers(
    images: Sequence[ObservedImage], answers: dict[str, Answers], protocol: SvrProtocol
) -> dict[str, Any]:
    """Scores by row: of the answers, and of training rooms, as they truly are, beside them."""
    rooms = known_rooms(protocol.shards)
    nearest = nearest_answers(rooms, images, open_renderer(protocol.renderer))
    drawn = random_answers(rooms, images, protocol.seed)
    answers = {
        **answers,
        "nearest_room": [one.objects for one in nearest],
        "random_room": [one.objects for one in drawn],
    }
    true_rooms = reference_scenes(protocol.shards, protocol.split, tracked_only=True)
    truth = {scene.name: scene.objects for scene in true_rooms}
    rows = {}
    for name, some in answers.items():
        views = []
        for image, objects in zip(images, some, strict=True):
            shown = [truth[image.room_id][row] for row in image.rows]
            views.append([ObjectPair(*pair) for pair in zip(shown, objects, strict=True)])
        rows[name] = score_views(views, protocol.points)
    return rows


def print_view_scores(scores: dict[str, Any], console: Console | None = None) -> None:
    """Print both tables of a result: all objects by method, and the first method by class."""
    rows = {TITLES[name]: row["summary"] for name, row in scores["rows"].items()}
    evaluated = next(iter(scores["rows"].values()))
    summary = evaluated["summary"]
    tables = {
        f"{summary['objects']} objects in {summary['images']} single views": rows,
        f"{next(iter(rows)).capitalize()}, by class": evaluated["classes"],
    }
    console = console or wide_console()
    for title, lines in tables.items():
        table = Table("", "objects", "unmatched", "with a surface", title=title)
        for name, _ in COLUMNS.values():
            table.add_column(name, justify="right")
        for label, row in lines.items():
            cells = (
                "–" if row[key] is None else form.format(row[key])
                for key, (_, form) in COLUMNS.items()
            )
            counts = (str(row[key]) for key in ("objects", "unmatched", "with_surface"))
            table.add_row(label, *counts, *cells)
        console.print(table)
    shards = scores["protocol"]["shards"]
    if note := surface_note(summary["objects"], summary["with_surface"], shards):
        console.print(f"Note: {note}", highlight=False)
