"""Losses of each room alone: what a batch of that one room has."""

from dataclasses import fields, replace

import torch
from torch import Tensor
from torch.testing import assert_close

from sceneprior.core.cameras import Boxes2D
from sceneprior.paper.losses import layout_losses, mask_loss, mean_of_objects
from sceneprior.paper.matching import Matches, match_objects


def only(thing, room: int):
    """The same batch, of one room."""
    changes = {
        item.name: getattr(thing, item.name)[room : room + 1]
        for item in fields(thing)
        if isinstance(getattr(thing, item.name), Tensor)
    }
    return replace(thing, **changes)


def test_layout_terms(batch):
    matches = match_objects(batch.scenes, batch.boxes, batch.views)
    found = layout_losses(batch.scenes, batch.boxes, batch.views, matches, 0.3, None)
    for room in range(3):
        alone = layout_losses(
            only(batch.scenes, room),
            Boxes2D(*(part[room : room + 1] for part in batch.boxes)),
            only(batch.views, room),
            Matches(*(part[room : room + 1] for part in matches)),
            0.3,
        )
        assert alone.keys() - {"completeness"} == found.keys()
        for name, value in found.items():
            assert value.shape == (3,)
            assert_close(value[room], alone[name], rtol=1e-6, atol=1e-9)


def test_mask_term(batch, torch_rng):
    ids = torch.randint(0, 4, (*batch.views.visible.shape[:2], 6, 8), generator=torch_rng)
    views = replace(batch.views, instance_ids=ids)
    matches = match_objects(batch.scenes, batch.boxes, views)
    shape = (*views.visible.shape[:2], batch.scenes.centers_m.shape[1], 6, 8)
    rendered = torch.rand(shape, generator=torch_rng, dtype=batch.scenes.centers_m.dtype)
    found, overlap = mask_loss(rendered, views, matches, 0.2, per_room=True)
    for room in range(3):
        mine = Matches(*(part[room : room + 1] for part in matches))
        alone, told = mask_loss(rendered[room : room + 1], only(views, room), mine, 0.2)
        assert_close(found[room], alone, rtol=1e-6, atol=1e-9)
        for name, value in told.items():
            assert_close(overlap[name][room], value, rtol=1e-6, atol=1e-9)


def test_a_room_without_anything_that_counts_is_zero():
    values = torch.tensor([[1.0, 3.0], [5.0, 7.0]])
    counted = torch.tensor([[True, True], [False, False]])
    assert mean_of_objects(values, counted, per_room=True).tolist() == [2.0, 0.0]
    assert mean_of_objects(values, counted).item() == 2.0
