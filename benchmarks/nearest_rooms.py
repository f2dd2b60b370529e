"""Draw new rooms, each beside the real training room that is nearest to it.

    python benchmarks/nearest_rooms.py RUN --sheet sheet.png [--distribution paper]

A picture of 24 pairs, the drawn room on the left, and the mean layout distance. Memory shows: a
copy stands beside itself.
"""

import argparse
from pathlib import Path
from statistics import mean

from PIL import Image

from sceneprior.config import load_any_run
from sceneprior.evaluation.ground_truth import reference_scenes
from sceneprior.evaluation.layout_distance import nearest_room
from sceneprior.generation.decode import synthesize
from sceneprior.offscreen import open_renderer
from sceneprior.pictures import contact_sheet
from sceneprior.topdown import corner_view, perspective

PAIRS, COLUMNS, TILE_PX = 24, 6, (210, 280)


def main() -> None:
    """Write the picture, print the distance."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("run", type=Path)
    options.add_argument("--sheet", type=Path, required=True, help="where the picture goes (PNG)")
    options.add_argument("--distribution", help="of the rooms (default: the run's)")
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--renderer", default="auto")
    given = options.parse_args()
    trained = load_any_run(given.run)
    drawn = synthesize(trained, PAIRS, given.seed, given.distribution)
    training = reference_scenes(Path(trained.config.data.shards), "train")
    renderer = open_renderer(given.renderer)
    tiles, distances = [], []
    for scene in drawn:
        row, distance = nearest_room(scene, training)
        distances.append(distance)
        for room in (scene, training[row]):
            tiles.append(perspective(room, renderer, view=corner_view([room], TILE_PX)))
    Image.fromarray(contact_sheet(tiles, COLUMNS, gap_px=4)).save(given.sheet, optimize=True)
    print(
        f"{PAIRS} rooms (from: {given.distribution or trained.distribution}, seed {given.seed}); "
        f"to the nearest of {len(training)} training rooms: {mean(distances):.2f} m on average, "
        f"{min(distances):.2f} at least"
    )


if __name__ == "__main__":
    main()
