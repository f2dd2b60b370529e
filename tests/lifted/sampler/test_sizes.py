"""Sizes and heights that repeat: clusters found by a plain loop, draws in proportion to numbers."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
import torch
from rooms_of_boxes import sampler_rooms
from torch.testing import assert_close

from sceneprior.lifted.prototypes import POSES
from sceneprior.lifted.sampler.prototype_statistics import COMMON, SAME_SIZE, find_sizes
from sceneprior.lifted.sampler.rooms import SamplerRooms


@pytest.fixture(scope="module")
def rooms() -> SamplerRooms:
    """Rooms of 40 pieces whose extents vary by up to a quarter."""
    rooms = sampler_rooms(40)
    scale = torch.from_numpy(np.random.default_rng(3).uniform(0.8, 1.25, (40, 1, 3))).float()
    sizes_m = rooms.rooms.boxes_m[..., 3:] * scale
    rooms.rooms = replace(
        rooms.rooms, boxes_m=torch.cat([rooms.rooms.boxes_m[..., :3], sizes_m], dim=-1)
    )
    return rooms


def complete_linkage(own_m: list[np.ndarray]) -> list[list[np.ndarray]]:
    """Join the two clusters whose farthest members are nearest, until none are within
    `SAME_SIZE`."""
    clusters = [[each] for each in own_m]

    def apart(pair: tuple[int, int]) -> float:
        first, second = (clusters[each] for each in pair)
        return max(np.abs(np.log(a) - np.log(b)).max() for a in first for b in second)

    while len(clusters) > 1:
        pair = min(combinations(range(len(clusters)), 2), key=apart)
        if apart(pair) > SAME_SIZE:
            break
        clusters[pair[0]] += clusters.pop(pair[1])
    return clusters


def test_entries_are_those_of_a_plain_loop(rooms):
    found_m, bottoms_m, numbers = find_sizes(rooms.rooms, rooms.prototypes)
    own: dict[int, list[np.ndarray]] = {}
    heights_m: dict[tuple, float] = {}
    for room, item in rooms.rooms.is_object.nonzero().tolist():
        prototype, pose = divmod(int(rooms.rooms.looks[room, item]), POSES)
        size_m = rooms.rooms.boxes_m[room, item, 3:].double().numpy()
        own.setdefault(prototype, []).append(size_m[::-1] if pose % 2 else size_m)
        height_m = float(rooms.rooms.boxes_m[room, item, 1]) - size_m[1] / 2
        heights_m[tuple(own[prototype][-1])] = max(height_m, 0.0)
    assert max(map(len, own.values())) > 20
    for prototype, each in own.items():
        clusters = [one for one in complete_linkage(each) if len(one) >= COMMON]
        wanted = {tuple(np.median(one, axis=0).round(5)): len(one) for one in clusters}
        used = numbers[prototype] > 0
        rows_m = found_m[prototype, used].double().numpy().round(5)
        found = dict(zip(map(tuple, rows_m), numbers[prototype, used].tolist(), strict=True))
        assert len(found) > 1
        low_m = {
            tuple(np.median(one, axis=0).round(5)): np.median([heights_m[tuple(e)] for e in one])
            for one in clusters
        }
        for row_m, bottom_m in zip(rows_m, bottoms_m[prototype, used].tolist(), strict=True):
            nearest = min(low_m, key=lambda each: np.abs(np.array(each) - row_m).max())
            assert bottom_m == pytest.approx(low_m[nearest], abs=1e-5)
        assert sorted(found.values()) == sorted(wanted.values())
        assert_close(np.array(sorted(found)), np.array(sorted(wanted)), atol=2e-5, rtol=0)


def test_a_prototype_with_one_object_or_none_has_one_size():
    rooms = sampler_rooms()
    alone = rooms.rooms.only(torch.arange(len(rooms))[:, None] == 1)
    found_m, _, numbers = find_sizes(alone, rooms.prototypes)
    none = rooms.rooms.only(torch.zeros(len(rooms), 1, dtype=torch.bool))
    own_m, floor_m, ones = find_sizes(none, rooms.prototypes)
    assert_close(own_m[:, 0], torch.from_numpy(rooms.prototypes.sizes_m).float())
    wanted = torch.zeros_like(ones)
    wanted[:, 0] = 1
    assert not floor_m.any() and torch.equal(ones, wanted) and torch.equal(numbers, wanted)
    first = int(alone.looks[1, 0])
    assert_close(found_m[first // POSES, 0].sort().values, alone.boxes_m[1, 0, 3:].sort().values)


def test_slabs_are_not_sizes_of_their_prototype():
    """Two objects of one prototype become 3 times as thin: the other entries stay as they were."""
    rooms = sampler_rooms(40)
    first = rooms.rooms.looks // POSES == int(rooms.rooms.looks[0, 0]) // POSES
    slabs = (first & rooms.rooms.is_object).nonzero()[:2]
    boxes_m = rooms.rooms.boxes_m.clone()
    boxes_m[slabs[:, 0], slabs[:, 1], 3] /= 3
    thin = replace(rooms.rooms, boxes_m=boxes_m)
    without = rooms.rooms.is_object.clone()
    without[slabs[:, 0], slabs[:, 1]] = False
    kept = replace(rooms.rooms, is_object=without)
    for found, wanted in zip(
        find_sizes(thin, rooms.prototypes), find_sizes(kept, rooms.prototypes), strict=True
    ):
        assert torch.equal(found, wanted)
