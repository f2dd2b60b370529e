"""A run and shards in; how well single views are reconstructed, beside known rooms, out."""

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from sceneprior.evaluation.mesh_metrics import POINTS
from sceneprior.evaluation.reference import reference_scenes
from sceneprior.evaluation.view_scores import PROTOCOL, ObjectPair, score_views
from sceneprior.files import write_whole
from sceneprior.offscreen import open_renderer
from sceneprior.scene import Scene, SceneObject
from sceneprior.stages.runs import load_run
from sceneprior.tasks.known_rooms import known_rooms, nearest_answers, random_answers
from sceneprior.tasks.observed import ObservedImage, images_of_split
from sceneprior.tasks.reconstruct import FitOptions, reconstruct

TITLES = {
    "fit": "fitted",
    "fit_boxes": "the same, as boxes",
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


def judge_views(
    run: Path,
    shards: Path,
    split: str,
    limit: int | None,
    options: FitOptions,
    out: Path,
    renderer: str = "auto",
    checkpoint: str = "final",
    points: int = POINTS,
) -> dict[str, Any]:
    """Reconstruct one view of each room and score it, and known rooms, against the truth.

    Args:
        run: A run's folder.
        shards: With 3D ground truth; `train` is where known rooms come from.
        split: Whose rooms are reconstructed.
        limit: Only the first so many rooms.
        options: Of the fit; the seed also draws the views and the random rooms.
        out: JSON file to write.
        renderer: Kind of renderer.
        checkpoint: `final` or `best`.
        points: Drawn from each surface.

    Raises:
        InputError: the run or the shards cannot be used.
    """
    trained = load_run(run, checkpoint)
    images, blank = images_of_split(shards, split, options.seed, limit)
    truth = {scene.name: scene for scene in reference_scenes(shards, split, limit, True)}
    fitted = reconstruct(trained, images, options)
    plain = reconstruct(trained, images, replace(options, masks=False, refine=False))
    rooms = known_rooms(shards)
    nearest = nearest_answers(rooms, images, trained.config.loss, open_renderer(renderer))
    drawn = random_answers(rooms, images, trained.config.loss, options.seed)
    # Whoever has another answer to the same masks adds a row here, and its title above.
    rows: dict[str, Answers] = {
        "fit": [one.scene.objects for one in fitted],
        "fit_boxes": [one.scene.without_meshes().objects for one in fitted],
        "layout_fit": [one.scene.without_meshes().objects for one in plain],
        "nearest_room": [one.objects for one in nearest],
        "random_room": [one.objects for one in drawn],
    }
    scores = {
        "rows": {
            name: score_views(pairs_of(images, truth, answers), points)
            for name, answers in rows.items()
        },
        "mask_iou": sum(one.mask_iou for one in fitted) / len(fitted),
        "protocol": {
            "run": Path(run).resolve().name,
            "checkpoint": checkpoint,
            "stage": trained.stage,
            "shards": str(shards),
            "split": split,
            "views": "one a room, drawn at random from those that show an object",
            "rooms_without_such_a_view": blank,
            "fit": asdict(options),
            "points": points,
            **PROTOCOL,
        },
    }
    write_whole(out, (json.dumps(scores, indent=1) + "\n").encode())
    return scores


def pairs_of(
    images: Sequence[ObservedImage], truth: dict[str, Scene], answers: Answers
) -> list[list[ObjectPair]]:
    """Each object that an image shows, with what was found for its mask."""
    return [
        [
            ObjectPair(truth[image.room_id].objects[row], item)
            for row, item in zip(image.rows, objects, strict=True)
        ]
        for image, objects in zip(images, answers, strict=True)
    ]


def print_view_scores(scores: dict[str, Any], console: Console | None = None) -> None:
    """Print both tables of a result: all objects by method, and the fit by class."""
    rows = {TITLES[name]: row["summary"] for name, row in scores["rows"].items()}
    summary = scores["rows"]["fit"]["summary"]
    title = f"{summary['objects']} objects in {summary['images']} single views"
    console = console or Console()
    console.print(_table(title, rows))
    console.print(_table("Fitted, by class", scores["rows"]["fit"]["classes"]))


def _table(title: str, rows: dict[str, dict[str, Any]]) -> Table:
    table = Table("", "objects", "unmatched", title=title)
    for name, _ in COLUMNS.values():
        table.add_column(name, justify="right")
    for label, row in rows.items():
        cells = [
            "–" if row[key] is None else form.format(row[key]) for key, (_, form) in COLUMNS.items()
        ]
        table.add_row(label, str(row["objects"]), str(row["unmatched"]), *cells)
    return table
