"""Draws the picture of a comparison: a row of rooms, or of reconstructions, for each method."""

import textwrap
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from sceneprior.apps.config import load_any_run
from sceneprior.apps.experiments.comparison import (
    Comparison,
    Run,
    ViewComparison,
    shards_of,
    variants_of,
)
from sceneprior.apps.reconstruction.export import from_above, from_camera, masks_of
from sceneprior.apps.reconstruction.reconstruct import OBJECTS, FitOptions, reconstruct
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.files import write_whole
from sceneprior.core.ground_truth import independent_rooms, reference_scenes
from sceneprior.core.observed_image import images_of_split
from sceneprior.core.scene import Scene
from sceneprior.evaluation.room_sets import without_void
from sceneprior.render.offscreen import Renderer
from sceneprior.render.pictures import png_bytes
from sceneprior.render.scene_files import load_scene_folder
from sceneprior.render.topdown import topdown

ROOMS_SHOWN = 8
IMAGES_SHOWN = 4
DRAWN_FROM = 256
"""Number of training rooms whose objects the row of independent rooms uses; the meshes of thousands
of rooms would take gigabytes."""
TILE_PX = 160
MARGIN_PX = 190
TITLE_WIDTH = 22
"""Number of characters per line that fit into the margin."""


def write_figure(
    comparison: Comparison, runs: Sequence[Run], count: int | None, path: Path, renderer: Renderer
) -> None:
    """Draw the rooms or reconstructions of one run per method, below the real ones.

    `count` is the number of rooms that each run was evaluated with (`count_of`).
    """
    of = _answers if isinstance(comparison, ViewComparison) else _rooms
    write_whole(path, png_bytes(sheet(of(comparison, runs, count, renderer)), optimize=True))


def sheet(lines: dict[str, list[np.ndarray]]) -> Image.Image:
    """Arrange pictures in rows, each with its title in the margin."""
    longest = max(len(pictures) for pictures in lines.values())
    size = (MARGIN_PX + longest * TILE_PX, len(lines) * TILE_PX)
    page, font = Image.new("RGB", size, "white"), ImageFont.load_default(size=16)
    for number, (title, pictures) in enumerate(lines.items()):
        middle = (6, number * TILE_PX + TILE_PX // 2)
        text = textwrap.fill(title, TITLE_WIDTH)
        ImageDraw.Draw(page).text(middle, text, fill="black", anchor="lm", font=font)
        for column, picture in enumerate(pictures):
            inside = (TILE_PX - 2, TILE_PX - 2)
            tile = ImageOps.pad(
                Image.fromarray(picture), inside, Image.Resampling.BOX, color="white"
            )
            place = (MARGIN_PX + column * TILE_PX, number * TILE_PX)
            page.paste(ImageOps.expand(tile, 1, (200, 200, 200)), place)
    return page


def _rooms(
    comparison: Comparison, runs: Sequence[Run], count: int | None, renderer: Renderer
) -> dict[str, list[np.ndarray]]:
    """Top-down pictures of each run's first rooms, after those of real and independent rooms."""
    real = reference_scenes(shards_of(comparison, runs[0].rooms), "train", limit=DRAWN_FROM)
    independent = independent_rooms(real, ROOMS_SHOWN, comparison.sampling_seed, True)
    lines = {"Real training rooms": real, "Independent objects": independent}
    for run in runs:
        first = variants_of(comparison, run)[0]
        if run.scenes is not None:
            made = load_scene_folder(run.scenes)
        else:
            assert count is not None, "comparisons of new rooms count them"
            trained = load_any_run(run.folder / "run")
            made = sample_rooms(trained, count, comparison.sampling_seed, first.name)
        lines[first.title] = made
    return {
        title: [
            topdown(without_void(room), renderer, outlines=True) for room in rooms[:ROOMS_SHOWN]
        ]
        for title, rooms in lines.items()
    }


def _answers(
    comparison: Comparison, runs: Sequence[Run], count: int | None, renderer: Renderer
) -> dict[str, list[np.ndarray]]:
    """Pictures of each run's reconstructions of the same images, from the image's camera and from
    above, after the image's masks and the true room."""
    shards, limit = shards_of(comparison, runs[0].rooms), min(count or IMAGES_SHOWN, IMAGES_SHOWN)
    images, _ = images_of_split(shards, "test", comparison.sampling_seed, limit)
    rooms = {room.name: room for room in reference_scenes(shards, "test", limit, tracked_only=True)}
    answers: dict[str, list[Scene]] = {"Truth": []}
    for image in images:
        room = rooms[image.room_id]
        shown = tuple(room.objects[row] for row in image.rows)
        answers["Truth"].append(replace(room, objects=shown))
    for run in runs:
        trained = load_any_run(run.folder / "run")
        for fit in variants_of(comparison, run):
            found = reconstruct(trained, images, FitOptions(fit.name or OBJECTS))
            answers[fit.title] = [one.scene for one in found]
    lines: dict[str, list[np.ndarray]] = {"Masks": []}
    for image in images:
        masks = masks_of(image)
        lines["Masks"] += [masks, np.full_like(masks, 255)]
    for title, scenes in answers.items():
        lines[title] = []
        for image, scene in zip(images, scenes, strict=True):
            lines[title].append(from_camera(scene, image, renderer))
            lines[title].append(from_above(scene, image, renderer))
    return lines
