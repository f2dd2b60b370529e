"""Picture of sampled rooms, each next to its nearest real training room.

    python benchmarks/nearest_rooms.py RUN --sheet sheet.png [--distribution paper]

The picture has 24 pairs, with the sampled room on the left; the mean layout distance is printed.
Memorised training rooms appear as pairs of equal rooms.
"""

import argparse
from pathlib import Path
from statistics import mean

from PIL import Image

from sceneprior.apps.config import load_any_run
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.evaluation.metrics.novelty import nearest_room
from sceneprior.render.pictures import contact_sheet
from sceneprior.render.topdown import corner_view, perspective

PAIRS, COLUMNS, TILE_PX = 24, 6, (210, 280)


def main() -> None:
    """Write the picture, and print the distance."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("run", type=Path)
    options.add_argument("--sheet", type=Path, required=True, help="file of the picture (PNG)")
    options.add_argument("--distribution", help="distribution of the rooms (default: the run's)")
    options.add_argument("--seed", type=int, default=0)
    given = options.parse_args()
    trained = load_any_run(given.run)
    drawn = sample_rooms(trained, PAIRS, given.seed, given.distribution)
    training = reference_scenes(Path(trained.config.data.shards), "train")
    tiles, distances = [], []
    for scene in drawn:
        row, distance = nearest_room(scene, training)
        distances.append(distance)
        for room in (scene, training[row]):
            tiles.append(perspective(room, view=corner_view([room], TILE_PX)))
    Image.fromarray(contact_sheet(tiles, COLUMNS, gap_px=4)).save(given.sheet, optimize=True)
    print(
        f"{PAIRS} rooms (from: {given.distribution or trained.distribution}, seed {given.seed}); "
        f"to the nearest of {len(training)} training rooms: {mean(distances):.2f} m on average, "
        f"{min(distances):.2f} at least"
    )


if __name__ == "__main__":
    main()
