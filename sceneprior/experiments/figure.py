"""Draws a picture of a comparison: a row of rooms from above for each method."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sceneprior.config import load_any_run
from sceneprior.evaluation.ground_truth import independent_rooms, reference_scenes
from sceneprior.evaluation.synthesis import without_void
from sceneprior.evaluation.topdown import topdown
from sceneprior.experiments.comparison import Comparison, Run
from sceneprior.files import write_whole
from sceneprior.generation.decode import synthesize
from sceneprior.offscreen import Renderer
from sceneprior.pictures import contact_sheet, png_bytes
from sceneprior.scene import Scene

SHOWN = 8
DRAWN_FROM = 256
"""Training rooms that the independent row draws objects from: thousands of meshes are gigabytes."""
TILE_PX = 160
MARGIN_PX = 190


def write_figure(
    comparison: Comparison, runs: Sequence[Run], count: int, path: Path, renderer: Renderer
) -> None:
    """Draw the first rooms that each run generates, under the real and the independent ones.

    Args:
        comparison: Names the methods.
        runs: Finished ones on the same rooms, one a method.
        count: Rooms that each of them was evaluated by; the first few are drawn.
        path: PNG to write.
        renderer: From `sceneprior.offscreen.open_renderer`.
    """
    trained = [load_any_run(run.folder / "run") for run in runs]
    real = reference_scenes(Path(trained[0].config.data.shards), "train", limit=DRAWN_FROM)
    independent = independent_rooms(real, SHOWN, comparison.sampling_seed, True)
    rows = {"Real training rooms": real[:SHOWN], "Independent objects": independent}
    for run, prior in zip(runs, trained, strict=True):
        made = synthesize(prior, count, comparison.sampling_seed)
        rows[comparison.methods[run.method].title] = made[:SHOWN]
    sheet = np.concatenate([_row(title, scenes, renderer) for title, scenes in rows.items()])
    write_whole(path, png_bytes(sheet, optimize=True))


def _row(title: str, scenes: Sequence[Scene], renderer: Renderer) -> np.ndarray:
    label = Image.new("RGB", (MARGIN_PX, TILE_PX), "white")
    font = ImageFont.load_default(size=16)
    ImageDraw.Draw(label).text((6, TILE_PX // 2), title, fill="black", anchor="lm", font=font)
    tiles = []
    for scene in scenes:
        picture = Image.fromarray(topdown(without_void(scene), renderer, outlines=True))
        tile = picture.resize((TILE_PX - 2, TILE_PX - 2), Image.Resampling.BOX)
        tiles.append(np.pad(np.asarray(tile), ((1, 1), (1, 1), (0, 0)), constant_values=200))
    blank = np.full((TILE_PX, TILE_PX, 3), 255, dtype=np.uint8)
    return np.concatenate([np.asarray(label), contact_sheet(tiles or [blank], SHOWN)], axis=1)
