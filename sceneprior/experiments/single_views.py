"""Comparisons of answers to single views (Table 2): an `eval-svr` a run."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw, ImageFont

from sceneprior.config import load_any_run
from sceneprior.errors import InputError
from sceneprior.evaluation.ground_truth import known_in_3d, reference_scenes
from sceneprior.evaluation.metric import TableColumn
from sceneprior.experiments.comparison import Run, ViewComparison
from sceneprior.experiments.steps import Step, read_result
from sceneprior.experiments.table import Form, Row, arrowed, seeds_of
from sceneprior.experiments.task import CompareOptions, Task, first_row, shards_of
from sceneprior.files import write_whole
from sceneprior.offscreen import Renderer
from sceneprior.pictures import png_bytes
from sceneprior.reconstruction.export import from_above, from_camera, masks_of
from sceneprior.reconstruction.image import ObservedImage, images_of_split
from sceneprior.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.scene import Scene

SPLIT = "test"
OF_SHARDS = "shards"
"""In place of a folder of CAD models: those of the training rooms."""
SHAPES = {"fit": "as found", "fit_cad": "CAD models"}
"""Rows of a result that the table shows of a run."""
SHOWN = 4
TILE_PX = 150
TITLE_PX = 24


def _of_views(rows: Sequence[Row]) -> str:
    scores = rows[0].scores
    shards = Path(scores["protocol"]["shards"]).name
    surfaces = scores["with_surface"]
    objects = f"{scores['objects']} objects"
    if surfaces < scores["objects"]:
        objects += f" ({surfaces} of them with a known surface)"
    return (
        f"One view of each of {scores['images']} {SPLIT} rooms of {shards}, {objects}; 2D boxes, "
        f"masks, classes and cameras are given; seeds {seeds_of(rows)}."
    )


VIEWS = Form(
    columns={
        "box_iou_3d": (arrowed(TableColumn("3D box IoU", 3), "higher"), 1.0),
        "chamfer_l2_m": (
            arrowed(
                TableColumn("CD (m)", 3, "CD: mean distance to the other surface, both ways added"),
                "lower",
            ),
            1.0,
        ),
        "f_score": (arrowed(TableColumn("F at 5 cm", 3), "higher"), 1.0),
        "seconds": (
            arrowed(
                TableColumn("s an image", 3, "s an image: CPU seconds, all images together"),
                "lower",
            ),
            1.0,
        ),
    },
    references={
        "Nearest training room by masks": "nearest_room",
        "Random training room": "random_room",
    },
    variant="shapes",
    say=_of_views,
)


class SingleViews(Task):
    """Each run answers the same views, one a test room."""

    form = VIEWS

    def __init__(self, comparison: ViewComparison, options: CompareOptions):
        self.comparison, self.options = comparison, options

    def check(self, rooms: str) -> None:
        shards = shards_of(self.comparison, rooms)
        if not known_in_3d(shards, SPLIT):
            raise InputError(
                f"Single views are compared with true rooms, and the '{SPLIT}' rooms of {shards} "
                "are missing or not known in 3D; give shards of prep-front or prep-scannet."
            )

    def scoring(self, run: Run) -> list[Step]:
        shards, models = str(shards_of(self.comparison, run.rooms)), self.comparison.cad_models
        alike = ["--split", SPLIT, "--seed", str(self.comparison.sampling_seed)]
        alike += ["--renderer", self.options.renderer]
        if self.comparison.count is not None:
            alike += ["--limit", str(self.comparison.count)]
        if models is not None:
            alike += ["--models", shards if models == OF_SHARDS else models]
        scores = run.folder / "scores.json"
        paths = ["--run", str(run.folder / "run"), "--shards", shards, "--out", str(scores)]
        return [Step("scores", ["eval-svr", *paths, *alike], result=scores, depends_on=alike)]

    def rows(self, run: Run) -> list[Row]:
        found = read_result(run.folder / "scores.json")
        first = first_row(self.comparison, run)
        beside = {name: found["rows"][name]["summary"] for name in VIEWS.references.values()}
        rows: list[Row] = []
        for name, shapes in SHAPES.items():
            if name in found["rows"]:
                scores: dict[str, Any] = {**found["rows"][name]["summary"], **beside}
                scores["protocol"] = found["protocol"]
                if not rows:
                    scores["seconds"] = found["cpu_seconds_an_image"]
                costs = {} if rows else first.costs
                rows.append(replace(first, variant=shapes, scores=scores, costs=costs))
        return rows

    def draw(self, rooms: str, runs: Sequence[Run], path: Path, renderer: Renderer) -> None:
        """A line an image: its masks, then truth and each method, from its camera and above."""
        shards = shards_of(self.comparison, rooms)
        limit = min(self.comparison.count or SHOWN, SHOWN)
        images, _ = images_of_split(shards, SPLIT, self.comparison.sampling_seed, limit)
        true = reference_scenes(shards, SPLIT, limit, tracked_only=True)
        answers = {"Truth": _shown(true, images)}
        for run in runs:
            found = reconstruct(load_any_run(run.folder / "run"), images, FitOptions())
            answers[self.comparison.methods[run.method].title] = [one.scene for one in found]
        write_whole(path, png_bytes(figure(images, answers, renderer), optimize=True))


def _shown(rooms: Sequence[Scene], images: Sequence[ObservedImage]) -> list[Scene]:
    """Of each image's room the objects that the image shows."""
    named = {room.name: room for room in rooms}
    return [
        replace(room, objects=tuple(room.objects[row] for row in image.rows))
        for image in images
        for room in [named[image.room_id]]
    ]


def figure(
    images: Sequence[ObservedImage], answers: dict[str, list[Scene]], renderer: Renderer
) -> Image.Image:
    """A line an image: its masks, then of each answer by title the same camera's view and the plan.

    Args:
        answers: As many scenes as images, by the titles of their columns.
    """
    lines = []
    for row, image in enumerate(images):
        panels = [masks_of(image)]
        for scenes in answers.values():
            panels.append(from_camera(scenes[row], image, renderer))
            panels.append(from_above(scenes[row], image, renderer))
        tiles = [Image.fromarray(panel) for panel in panels]
        lines.append([tile.resize((_width(tile), TILE_PX)) for tile in tiles])
    widths = [max(line[column].width for line in lines) for column in range(len(lines[0]))]
    titles = ["Masks", *(part for title in answers for part in (title, ""))]
    size = (sum(widths) + 2 * len(widths), TITLE_PX + len(lines) * (TILE_PX + 2))
    sheet, font = Image.new("RGB", size, "white"), ImageFont.load_default(size=14)
    x = 0
    for column, (title, width) in enumerate(zip(titles, widths, strict=True)):
        ImageDraw.Draw(sheet).text((x + 2, 4), title, "black", font)
        for row, line in enumerate(lines):
            sheet.paste(line[column], (x, TITLE_PX + row * (TILE_PX + 2)))
        x += width + 2
    return sheet


def _width(tile: Image.Image) -> int:
    return max(round(tile.width * TILE_PX / tile.height), 1)
