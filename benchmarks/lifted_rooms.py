"""Training rooms as lifting sees them: how close to real rooms can drawn ones come?

Random training rooms of a lifted run, with the boxes found by lifting and the shapes of their
prototypes, written as scenes. No network has drawn them, so what is missing in their pictures is
missing in what the sampler learns from:

    python benchmarks/lifted_rooms.py RUN OUT --rooms 400
    sceneprior eval-fid --scenes OUT --boxes --shards SHARDS
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from sceneprior.apps.config import load_any_run
from sceneprior.apps.rooms import write_scenes
from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene
from sceneprior.lifted.config import LiftedConfig
from sceneprior.lifted.drawing.draw import SampledRooms, _scene_of
from sceneprior.lifted.prototype_decoder import PrototypeDecoder
from sceneprior.lifted.requests.wishes import Conditions
from sceneprior.lifted.sampler.rooms import SamplerRooms, frames_of
from sceneprior.lifted.trained import TrainedLifted


def lifted_rooms(run: str, count: int) -> list[Scene]:
    """`count` random training rooms of a run, in the shapes of its prototypes."""
    trained = load_any_run(run)
    assert isinstance(trained, TrainedLifted), "a run of the lifted method"
    config, shapes = trained.config, trained.prior.shape
    assert isinstance(config, LiftedConfig) and isinstance(shapes, PrototypeDecoder)
    every = SamplerRooms(config.open_lifted()).assign_prototypes(shapes.prototypes)
    picked = np.random.default_rng(0).permutation(len(every))[:count]
    rooms = every.rooms.changed(lambda part: part[torch.from_numpy(picked)])
    rooms = replace(rooms, room_ids=tuple(every.plain_ids[row] for row in picked))
    rooms = replace(rooms, rectangle_m=frames_of(rooms, torch.Generator().manual_seed(0)))
    drawn = SampledRooms(rooms, (None,) * count, ((),) * count, ("",) * count)
    conditions = Conditions(tuple(label_set(config.label_set)))
    return [
        _scene_of(trained, f"lifted_{row}", conditions, drawn, row, False) for row in range(count)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run")
    parser.add_argument("out", type=Path)
    parser.add_argument("--rooms", type=int, default=400)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    write_scenes(lifted_rooms(options.run, options.rooms), options.out)


if __name__ == "__main__":
    main()
