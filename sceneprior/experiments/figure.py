"""Draws a picture of a comparison: a row of rooms from above for each method."""

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont, ImageOps

from sceneprior.config import load_any_run
from sceneprior.evaluation.ground_truth import independent_rooms, reference_scenes
from sceneprior.evaluation.room_sets import without_void
from sceneprior.experiments.comparison import RoomComparison, Run, distributions_of
from sceneprior.files import write_whole
from sceneprior.generation.decode import synthesize
from sceneprior.offscreen import Renderer
from sceneprior.pictures import png_bytes
from sceneprior.topdown import topdown

SHOWN = 8
DRAWN_FROM = 256
"""Training rooms that the independent row draws objects from: thousands of meshes are gigabytes."""
TILE_PX = 160
MARGIN_PX = 190


def write_figure(
    comparison: RoomComparison, runs: Sequence[Run], count: int, path: Path, renderer: Renderer
) -> None:
    """Draw the first rooms that each run generates, under the real and the independent ones.

    Args:
        runs: Finished ones on the same rooms, one a method.
        count: Rooms that each of them was evaluated by.
    """
    trained = [load_any_run(run.folder / "run") for run in runs]
    real = reference_scenes(Path(trained[0].config.data.shards), "train", limit=DRAWN_FROM)
    independent = independent_rooms(real, SHOWN, comparison.sampling_seed, True)
    rows = {"Real training rooms": real[:SHOWN], "Independent objects": independent}
    for run, prior in zip(runs, trained, strict=True):
        latents = distributions_of(comparison, run)[0]
        made = synthesize(prior, count, comparison.sampling_seed, latents)
        rows[comparison.methods[run.method].title] = made[:SHOWN]
    size = (MARGIN_PX + SHOWN * TILE_PX, len(rows) * TILE_PX)
    sheet, font = Image.new("RGB", size, "white"), ImageFont.load_default(size=16)
    for row, (title, scenes) in enumerate(rows.items()):
        middle = (6, row * TILE_PX + TILE_PX // 2)
        ImageDraw.Draw(sheet).text(middle, title, fill="black", anchor="lm", font=font)
        for column, scene in enumerate(scenes):
            picture = Image.fromarray(topdown(without_void(scene), renderer, outlines=True))
            tile = picture.resize((TILE_PX - 2, TILE_PX - 2), Image.Resampling.BOX)
            place = (MARGIN_PX + column * TILE_PX, row * TILE_PX)
            sheet.paste(ImageOps.expand(tile, 1, (200, 200, 200)), place)
    write_whole(path, png_bytes(sheet, optimize=True))
