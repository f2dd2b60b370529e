"""Frechet distances to the test rooms of decoded training rooms, and of samples by distribution.

Run `python benchmarks/sampling_distributions.py RUN [RUN ...]`. Decoded training rooms are a limit
for generated rooms: the distance of decoded training rooms measures the decoder, and the excess of
generated rooms over this distance measures the sampling distribution. The distances are in
EfficientNet-Lite0 features (not FID), for seed 0 and as many rooms as training rooms; the values in
brackets are for rooms drawn as boxes.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneprior.apps.config import load_run
from sceneprior.apps.experiments.evaluate import decoded_and_true
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import Scene
from sceneprior.evaluation.features import Drawing
from sceneprior.evaluation.metrics.picture_distances import frechet_distance
from sceneprior.evaluation.room_sets import without_void

DISTRIBUTIONS = ("kernel", "paper")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "runs", type=Path, nargs="+", help="runs that keep the latents of training rooms"
    )
    for name in parser.parse_args().runs:
        trained = load_run(name)
        shards = Path(trained.config.data.shards)
        drawing = Drawing(trained.config.label_set)

        def features(scenes: Sequence[Scene], drawing=drawing) -> np.ndarray:
            known = [without_void(scene) for scene in scenes]
            return drawing.features(known)["effnet_lite0"]

        test = reference_scenes(shards, "test")
        real = features(test), features([scene.without_meshes() for scene in test])
        rooms = {"decoded": [decoded for decoded, _ in decoded_and_true(trained, shards)]}
        for distribution in DISTRIBUTIONS:
            rooms[distribution] = sample_rooms(trained, len(rooms["decoded"]), 0, distribution)
        for what, scenes in rooms.items():
            boxes = features([scene.without_meshes() for scene in scenes])
            apart = frechet_distance(features(scenes), real[0]), frechet_distance(boxes, real[1])
            print(f"{name}  {what:9} {apart[0]:6.1f} ({apart[1]:.1f})", flush=True)


if __name__ == "__main__":
    main()
