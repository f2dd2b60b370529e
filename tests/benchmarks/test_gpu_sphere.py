"""Views of shards in one file, for `benchmarks/gpu_sphere.py`: cameras with their own boxes."""

from pathlib import Path

import gpu_sphere
import numpy as np
import torch

from sceneprior.core.dataset import ViewDataset


def test_views_of_a_file_are_those_of_the_shards(toy_shards: Path, tmp_path: Path):
    data = ViewDataset(toy_shards, "train", 1)
    gpu_sphere.write_views(toy_shards, tmp_path / "flat.npz")
    rooms = gpu_sphere.Rooms(
        tmp_path / "flat.npz", len(data.flat.object_count), data.max_objects, "cpu", 0
    )
    assert rooms.views == gpu_sphere.VIEWS_KEPT and rooms.image_size == data._image_sizes[0]
    batch = rooms.batch(np.arange(len(rooms.used)))
    for room, row in enumerate(rooms.used):
        count = int(data.flat.object_count[row])
        first, sighting = int(data.flat.first_view[row]), int(data.flat.first_sighting[row])
        cameras = data.flat.world_to_camera[first : first + data._view_counts[row]]
        assert batch.is_object[room].sum() == count
        labels = data.flat.object_class[int(data.flat.first_object[row]) :][:count]
        assert torch.equal(batch.object_class[room, :count], labels.long())
        for view in range(gpu_sphere.VIEWS):
            same = (cameras == batch.world_to_camera[room, view]).flatten(1).all(dim=1)
            at = sighting + int(same.nonzero()[0, 0]) * count
            own = slice(at, at + count)
            assert torch.equal(batch.boxes[room, view, :count], data.flat.boxes[own])
            assert torch.equal(batch.visible[room, view, :count], data.flat.visible[own])
            assert torch.equal(batch.sides_clear[room, view, :count], data.flat.sides_clear[own])
