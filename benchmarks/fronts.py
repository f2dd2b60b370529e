"""Share of furniture whose front is found from masks alone, against the true yaws, by class.

Run `python benchmarks/fronts.py SHARDS [SHARDS ...]` for rooms in 3D-FRONT's format. `--fit SHARDS`
also fits the weights of `sampler/orientation.py` to the true yaws of other rooms, and prints them:
a conditional logit over the four sides of an object, by kind of furniture. Objects whose yaw is
more than 15 degrees from the axes, and classes without a front, are left out.
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from sceneprior.core.classes import label_set
from sceneprior.core.shards import iterate_rooms
from sceneprior.lifted.lifting import ShapeGrid
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.prototypes import POSES
from sceneprior.lifted.sampler import orientation
from sceneprior.lifted.sampler.frames import own_sides, side_of
from sceneprior.lifted.sampler.rooms import SamplerRooms

GRID = ShapeGrid(32, 1.1)
NO_FRONT = ("ceiling_lamp", "coffee_table", "pendant_lamp", "stool", "table", "void")
UPRIGHT_RAD = np.radians(15)
RIDGE = 0.01
BINS = (0.0, 0.7, 0.8, 0.9, 0.95)


class Found:
    """Rooms of a split with looks, and the side of each object's true back (-1 if left out)."""

    def __init__(self, shards: Path, split: str, prototypes: int):
        lifted = LiftedDataset(shards, split, GRID)
        self.samples = SamplerRooms(lifted)
        self.samples.assign_prototypes(lifted.find_prototypes(prototypes))
        self.names = label_set(lifted.label_set)
        looks, _ = lifted.posed_prototypes(self.samples.prototypes)
        self.back = torch.full(self.samples.rooms.is_object.shape, -1)
        first = 0
        for row, (shard, room_id) in enumerate(iterate_rooms(shards, split)):
            count = lifted.counts[row]
            kept = looks[first : first + count] >= 0
            yaws = shard.read_ground_truth(room_id).yaw_rad[:count][kept]
            quarters = np.round(yaws / (np.pi / 2))
            # A front at high z is turned by 0 quarters, and its back is at low z.
            sides = np.array([0, 1, 2, 3])[quarters.astype(int) % 4]
            off = np.abs(yaws - quarters * np.pi / 2) > UPRIGHT_RAD
            self.back[row, : len(yaws)] = torch.from_numpy(np.where(off, -1, sides))
            first += count
        here = self.samples.rooms.is_object
        labels = self.samples.rooms.object_class
        fronts = torch.tensor([name not in NO_FRONT for name in self.names])
        self.back[~(here & fronts[labels])] = -1

    def cues(self) -> tuple[torch.Tensor, torch.Tensor, list[str]]:
        """Cues of the four sides of each object with a true back; the backs; and the kinds."""
        rooms, known = self.samples.rooms, self.back >= 0
        assert rooms.looks is not None
        of_room = orientation.room_cues(rooms, self.samples.to_walls_m, self.names)
        shape = orientation.shape_cues(self.samples.prototypes)[rooms.looks // POSES]
        # From the prototype's sides to the room's.
        order = own_sides(rooms.looks).argsort(dim=-1).unsqueeze(-1)
        cues = torch.cat([of_room.double(), shape.gather(2, order.expand_as(shape))], dim=-1)
        kinds = [orientation.kind_of(self.names[row]) for row in rooms.object_class[known].tolist()]
        return cues[known], self.back[known], kinds


def fit(data: list[Found]) -> dict[str, tuple[float, ...]]:
    """Weights by kind, at the highest penalised likelihood of the true backs."""
    cues, backs, kinds = zip(*(each.cues() for each in data), strict=True)
    x, y, kind = torch.cat(cues), torch.cat(backs), np.concatenate(kinds)
    found = {}
    for name in orientation.WEIGHTS:
        own = torch.from_numpy(kind == name)
        found[name] = _fitted(x[own], y[own])
        print(f"{name}: {int(own.sum())} objects, {found[name]}")
    return found


def _fitted(x: torch.Tensor, y: torch.Tensor) -> tuple[float, ...]:
    weights = torch.zeros(x.shape[-1], dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([weights], max_iter=200)

    def loss() -> torch.Tensor:
        optimizer.zero_grad()
        value = F.cross_entropy(x @ weights, y) + RIDGE * weights.square().sum()
        value.backward()
        return value

    optimizer.step(loss)
    return tuple(round(float(weight), 2) for weight in weights.detach())


def report(title: str, found: Found) -> None:
    rooms, known = found.samples.rooms, found.back >= 0
    assert rooms.looks is not None
    right = side_of(rooms.looks, found.samples.backs) == found.back
    sure = found.samples.confidence[rooms.looks // POSES]
    by_class = defaultdict(list)
    for label, good in zip(rooms.object_class[known].tolist(), right[known].tolist(), strict=True):
        by_class[found.names[label]].append(good)
    print(f"{title}: {right[known].double().mean():.3f} of {int(known.sum())} fronts are right")
    for low, high in zip(BINS, (*BINS[1:], 1.01), strict=True):
        some = known & (sure >= low) & (sure < high)
        if some.any():
            share, said = right[some].double().mean(), sure[some].mean()
            span = f"{low:.2f} to {high:.2f}"
            print(f"  confidence {span}: {share:.2f} of {int(some.sum())} ({said:.2f})")
    for name, goods in sorted(by_class.items()):
        print(f"  {name}: {np.mean(goods):.2f} of {len(goods)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("shards", nargs="+", type=Path)
    parser.add_argument("--fit", nargs="+", type=Path, default=[], help="fit the weights to these")
    parser.add_argument("--split", default="train")
    parser.add_argument("--prototypes", type=int, default=512)
    given = parser.parse_args()
    if given.fit:
        orientation.WEIGHTS.update(
            fit([Found(path, "train", given.prototypes) for path in given.fit])
        )
    for path in given.shards:
        report(f"{path.name}, {given.split}", Found(path, given.split, given.prototypes))


if __name__ == "__main__":
    main()
