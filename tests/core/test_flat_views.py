"""A split laid end to end: sizes, and room by room what the shards hold."""

from dataclasses import fields

from references.batches import rooms_with_images

from sceneprior.core.dataset import FlatViews


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
