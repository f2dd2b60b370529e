"""A split laid end to end: sizes, and room by room what the shards hold."""

from dataclasses import fields

import torch
from references.batches import rooms_with_images

from sceneprior.core.data.dataset import FlatViews


def test_a_hundred_thousand_views_take_tens_of_megabytes(toy_shards):
    rooms = rooms_with_images(toy_shards, "train")
    flat = FlatViews.of(rooms)
    views = sum(len(room.visible) for room in rooms)
    sightings = sum(room.visible.size for room in rooms)
    objects = sum(len(room.object_class) for room in rooms)
    # Pose and lens; box, visible and four sides; class; four places a room; the two last rows.
    held = sum(getattr(flat, item.name).nbytes for item in fields(flat))
    assert held == 100 * views + 21 * sightings + 2 * objects + 32 * len(rooms) + 23
    # Rooms of 30 views and 8 objects, more than an average bedroom has.
    assert 100_000 * (100 + 21 * 8 + (2 * 8 + 32) / 30) < 30e6


def test_padding_is_nothing(toy_shards):
    flat = FlatViews.of(rooms_with_images(toy_shards, "train"))
    room, view = torch.tensor([0, 1]), torch.tensor([[0, 3], [2, 2]])
    batch = flat.gather(room, view, torch.zeros(2, dtype=torch.long), objects=9)
    padding = ~batch["is_object"]
    assert padding.sum() == 18 - int(flat.object_count[:2].sum())
    assert not batch["object_class"][padding].any()
    for name in ("boxes", "visible", "sides_clear"):
        assert not batch[name].transpose(1, 2)[padding].any()
        assert torch.equal(batch[name][1, 0], batch[name][1, 1])  # the same view, twice
