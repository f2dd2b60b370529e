"""Shards whose training rooms come from masks of single frames, to train a prior on.

Run `python benchmarks/untracked_prior.py SHARDS OUT [--noise noisy]`, then `sceneprior fit` with
`data.shards=OUT`. The shards must hold 3D ground truth, as those of `sceneprior demo` do. Every
mask of a training room gets a unique id, after the noise of tracks.py; its objects are those found
by `prep-posed --tracks auto`, and it keeps no ground truth. Val and test rooms are copied. Evaluate
with `--shards SHARDS`. A table of the objects found, as that of tracks.py, is printed at the end.
"""

import argparse
import shutil
from collections.abc import Iterator
from pathlib import Path

from tracks import HEADER, NOISES, Noise, Score, find, observed, score, table_row

from sceneprior.core.files import write_json
from sceneprior.core.observations import RoomViews
from sceneprior.core.shard_writing import shard_bytes
from sceneprior.core.shards import INDEX_NAME, Shard, list_shards, read_index

TRAIN = "train"


def found_rooms(shard: Shard, noise: Noise, scores: list[Score]) -> Iterator[RoomViews]:
    """Rooms of a shard with the objects found in them; each one's score is appended to `scores`,
    whose length is the seed of its noise."""
    for room_id in shard.room_ids:
        views, truth = shard.read_room(room_id, images=True), shard.read_ground_truth(room_id)
        found = find(views, noise, seed=len(scores))
        scores.append(score(views, truth, found))
        poses = found.frames.world_to_camera
        yield observed(views, found.tracks.ids, found.tracks.object_class, poses)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("shards", type=Path)
    parser.add_argument("out", type=Path, help="a new folder")
    parser.add_argument("--noise", choices=NOISES, default="clean")
    options = parser.parse_args()
    unlike = shutil.ignore_patterns(TRAIN, INDEX_NAME, "report.*", "*.npz")
    shutil.copytree(options.shards, options.out, ignore=unlike)
    (options.out / TRAIN).mkdir()
    scores: list[Score] = []
    for path in list_shards(options.shards, TRAIN):
        with Shard(path) as shard:
            rooms = found_rooms(shard, NOISES[options.noise], scores)
            data = shard_bytes(path.name, shard.label_set, ((views, None) for views in rooms))
        (options.out / TRAIN / path.name).write_bytes(data)
    index = read_index(options.shards)
    index["counts"][TRAIN]["objects"] = sum(room.found for room in scores)
    write_json(options.out / INDEX_NAME, index)
    print(HEADER)
    print(table_row(f"{options.shards.name} {TRAIN}", options.noise, scores))


if __name__ == "__main__":
    main()
