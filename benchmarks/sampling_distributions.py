"""How far from the test rooms are a run's decoded training rooms, and new ones by distribution?

Run `python benchmarks/sampling_distributions.py RUN [RUN ...]`. What a prior generates can hardly
be nearer to test rooms than what it decodes from the latents it was trained with: the difference is
what sampling costs, the rest is how well it decodes. Frechet distances of EfficientNet-Lite0
features (not FID), seed 0, as many rooms as training rooms; in brackets all rooms drawn as boxes.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sceneprior.config import load_run
from sceneprior.evaluation.features import Drawing
from sceneprior.evaluation.ground_truth import reference_scenes
from sceneprior.evaluation.metrics.frechet import frechet_distance
from sceneprior.evaluation.room_sets import without_void
from sceneprior.experiments.evaluate import decoded_and_true
from sceneprior.generation.decode import synthesize
from sceneprior.offscreen import open_renderer
from sceneprior.scene import Scene

DISTRIBUTIONS = ("kernel", "geodesic", "paper")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("runs", type=Path, nargs="+", help="that remember training rooms")
    for name in parser.parse_args().runs:
        trained = load_run(name)
        shards = Path(trained.config.data.shards)
        drawing = Drawing(trained.config.label_set, open_renderer("auto"))

        def features(scenes: Sequence[Scene], drawing=drawing) -> np.ndarray:
            known = [without_void(scene) for scene in scenes]
            return drawing.features(known)["effnet_lite0"]

        test = reference_scenes(shards, "test")
        real = features(test), features([scene.without_meshes() for scene in test])
        rooms = {"decoded": [decoded for decoded, _ in decoded_and_true(trained, shards)]}
        for distribution in DISTRIBUTIONS:
            rooms[distribution] = synthesize(trained, len(rooms["decoded"]), 0, distribution)
        for what, scenes in rooms.items():
            boxes = features([scene.without_meshes() for scene in scenes])
            apart = frechet_distance(features(scenes), real[0]), frechet_distance(boxes, real[1])
            print(f"{name}  {what:9} {apart[0]:6.1f} ({apart[1]:.1f})", flush=True)


if __name__ == "__main__":
    main()
