"""Rooms, shapes and a small sampler for tests, made from numbers alone."""

from pathlib import Path

import numpy as np
import torch
from parts_of_rooms import boxes, rays_of

from sceneprior.core.parts import Parts, filled_cells
from sceneprior.core.wall_lines import Wall
from sceneprior.lifted.lifting import LiftedBoxes, RayPool, ShapeGrid
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.sampler.network import RoomSampler, SamplerConfig
from sceneprior.lifted.sampler.prototype_statistics import teach
from sceneprior.lifted.sampler.rooms import SamplerRooms

CLASSES, CELLS, PROTOTYPES = 5, 8, 12
RAYS = 400
TINY = {"epochs": 2, "width": 16, "layers": 1, "heads": 2, "dropout": 0.0}


SOFA = boxes((0, 32, 0, 64, 0, 64), (32, 64, 0, 64, 0, 32))
"""L-shaped: one corner is empty."""
PLAIN = boxes((0, 64, 0, 64, 0, 64))


class Lifted(LiftedDataset):
    """Rooms without shards: what the sampler reads of lifted ones."""

    def __init__(self, boxes: list[LiftedBoxes], classes: list[int], shapes: list[Parts]):
        self.rotations, self.label_set = 1, "void,sofa,box,pole"
        self.counts = [len(room.explained) for room in boxes]
        self.boxes = LiftedBoxes(*(np.concatenate(part) for part in zip(*boxes, strict=True)))
        columns = [np.split(part, np.cumsum(self.counts)[:-1]) for part in self.boxes]
        self.its_boxes = [LiftedBoxes(*room) for room in zip(*columns, strict=True)]  # to change
        self._parts_file, self._key = Path("no folder") / "parts.npz", ""
        self.plain_ids = [f"room{row}" for row in range(len(boxes))]
        self.object_classes = np.array(classes, dtype=np.int64)
        self._shape = ShapeGrid(CELLS, 1.0)
        pools = [rays_of(each, RAYS, row, margin=1.0) for row, each in enumerate(shapes)]
        self.rays = RayPool(*(np.stack(part) for part in zip(*pools, strict=True)))
        self._hulls = np.stack([filled_cells(each, CELLS, 1.0) for each in shapes])
        self.walls: list[list[Wall]] = [[] for _ in boxes]

    def hulls(self) -> np.ndarray:
        return self._hulls


def lifted_rooms(count: int = 6, seed: int = 0) -> Lifted:
    """An L-shaped sofa (1), a box (2), and in every other room a thin box (3), far enough from each
    other."""
    rng = np.random.default_rng(seed)
    boxes, classes, shapes = [], [], []
    for room in range(count):
        labels = [1, 2, 3][: 2 + room % 2]
        sizes = np.array([[2.0, 0.8, 1.4], [0.5, 0.5, 0.5], [0.3, 1.5, 0.3]])[: len(labels)]
        sizes = sizes * rng.uniform(0.98, 1.02, sizes.shape)
        x = np.array([-1.0, 0.7, 1.4])[: len(labels)] + rng.uniform(-0.1, 0.1, len(labels))
        centers = np.stack([x, sizes[:, 1] / 2, rng.uniform(-0.5, 0.5, len(labels))], axis=1)
        boxes.append(LiftedBoxes(centers, sizes, np.ones(len(labels))))
        classes += labels
        shapes += [SOFA, PLAIN, PLAIN][: len(labels)]
    return Lifted(boxes, classes, shapes)


def sampler_rooms(count: int = 6, seed: int = 0) -> SamplerRooms:
    """The same with looks, of prototypes that the first six rooms have."""
    return SamplerRooms(lifted_rooms(count, seed)).assign_prototypes(
        lifted_rooms().find_prototypes(99)
    )


def small_sampler(rooms: SamplerRooms, seed: int = 0, **settings: object) -> RoomSampler:
    """Untrained, but it knows its rooms."""
    torch.manual_seed(seed)
    config = SamplerConfig.model_validate({**TINY, **settings})
    sampler = RoomSampler(config, CLASSES, PROTOTYPES, max_objects=5)
    teach(sampler, rooms)
    return sampler.eval()
