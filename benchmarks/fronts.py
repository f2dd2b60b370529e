"""Accuracy of the fronts that a prior gives to furniture.

    python benchmarks/fronts.py PRIOR SHARDS [--split test]

Objects are lifted from their masks and assigned to the posed prototype of the prior that explains
the masks best; the true yaw in the shards defines the true front. The table has a row for each
class and for each range of the prior's confidence. Classes without a front are left out of the
total: lamps, tables and stools.
"""

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool

import sceneprior
from sceneprior.core.classes import label_set
from sceneprior.core.shards import iterate_rooms
from sceneprior.lifted.config import TrainedLifted
from sceneprior.lifted.lifting import ShapeGrid
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.prototype_decoder import PrototypeDecoder
from sceneprior.lifted.prototypes import POSES
from sceneprior.lifted.requests.relations import OUTWARD
from sceneprior.lifted.sampler.frames import side_of

WITHOUT_FRONT = ("lamp", "table", "stool")
"""Words in the names of classes without a front; a `dressing_table` has one."""
RANGES = (0.0, 0.5, 0.7, 0.9, 1.01)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("prior")
    parser.add_argument("shards", type=Path)
    parser.add_argument("--split", default="test")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    trained = sceneprior.load(arguments.prior).trained
    assert isinstance(trained, TrainedLifted) and trained.sampler is not None
    shapes = trained.prior.shape
    assert isinstance(shapes, PrototypeDecoder)
    grid = ShapeGrid(shapes.cells, shapes.margin)
    lifted = LiftedDataset(arguments.shards, arguments.split, shape=grid)
    looks = torch.from_numpy(lifted.posed_prototypes(shapes.prototypes.common_alone()))
    yaws = [
        shard.read_ground_truth(name).yaw_rad[: len(shard.read_room(name).object_class)]
        for shard, name in iterate_rooms(arguments.shards, arguments.split)
    ]
    sampler = trained.sampler
    sure = sampler.front_confidence[looks.clamp(min=0) // POSES].numpy()
    found = OUTWARD[side_of(looks.clamp(min=0), sampler.fronts).numpy()]
    yaw = np.concatenate(yaws)
    right = (found * np.stack([np.sin(yaw), np.cos(yaw)], axis=1)).sum(axis=1) > np.cos(np.pi / 4)
    known = (looks >= 0).numpy() & (sure > 0)
    names = np.array(label_set(trained.config.label_set))[lifted.object_classes]
    with_front = np.array([has_front(name) for name in names])
    print("| objects | number | front right | mean confidence |\n| --- | ---: | ---: | ---: |")

    def row(title: str, which: Bool[np.ndarray, " objects"]) -> None:
        if which.any():
            share, confidence = right[which].mean(), sure[which].mean()
            print(f"| {title} | {which.sum()} | {share:.2f} | {confidence:.2f} |")

    row("all with a front", known & with_front)
    for low, high in pairwise(RANGES):
        row(
            f"confidence {low:g} to {min(high, 1):g}",
            known & with_front & (sure >= low) & (sure < high),
        )
    for name in np.unique(names[known]):
        row(name.replace("_", " "), known & (names == name))


def has_front(label: str) -> bool:
    """True for classes with a front."""
    return label == "dressing_table" or not any(word in label for word in WITHOUT_FRONT)


if __name__ == "__main__":
    main()
