"""Whole reconstructions on a toy run: options, starts, answers in the masks' order."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import refused
from torch.testing import assert_close

from sceneprior.apps.reconstruction import reconstruct as reconstruct_module
from sceneprior.apps.reconstruction.reconstruct import (
    layout_losses_of_rooms,
    reconstruct,
)
from sceneprior.core.classes import label_set
from sceneprior.core.views import as_views, images_of_split, rows_of
from sceneprior.paper.fit_image import SCHEDULES, FitSchedule, decode_images, view_loss


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setitem(SCHEDULES, "short", FitSchedule(steps=10, drop_at=6, patience=0))


def test_images_of_any_size_and_number_come_back_in_their_order(trained, images, monkeypatch):
    half = replace(
        images[1],
        instance_ids=images[1].instance_ids[::2, ::2],
        intrinsics=np.diag([0.5, 0.5, 1]) @ images[1].intrinsics,
    )
    monkeypatch.setattr(reconstruct_module, "BATCH", 2)
    given = [images[3], half, images[0], images[2]]
    found = reconstruct(trained, given, "short")
    assert [one.image is image for one, image in zip(found, given, strict=True)] == [True] * 4
    alone = reconstruct(trained, [images[0]], "short")[0]
    assert found[2].score == pytest.approx(alone.score, rel=1e-3)


def test_more_restarts_are_never_worse_and_the_best_is_kept(trained, images):
    one, three = (reconstruct(trained, images, "short", restarts=n) for n in (1, 3))
    # The first start is the same; sums in another order may move its score a little.
    assert all(b.score <= a.score + 1e-3 for a, b in zip(one, three, strict=True))
    assert any(b.score < a.score - 1e-3 for a, b in zip(one, three, strict=True))


def test_options_and_images_that_cannot_be(trained, images):
    other = replace(images[0], label_set="scannet")
    for name, some, options in (
        ("fit", images, dict(fit="long")),
        ("restarts_of_objects", images, dict(restarts=2)),
        ("no_restarts", images, dict(restarts=0)),
        ("label_set", [other], dict(fit="short")),
        ("restarts", images, dict(fit="short", restarts=13)),
    ):
        with refused(f"apps/reconstruct_{name}"):
            reconstruct(trained, some, **options)


def test_an_object_of_a_class_that_the_run_never_generates(trained, images):
    """Whatever else looks like its mask stands for it, and is told; its class stays the image's."""
    names = label_set(images[0].label_set)
    with torch.no_grad():
        rooms = [trained.prior(row.unsqueeze(0), False).class_logits[0] for row in trained.logits]
    generated = {names[int(logits.argmax())] for room in rooms for logits in room}
    assert "sofa" not in generated  # no toy room has one
    classes = images[0].object_class.copy()
    classes[0] = names.index("sofa")
    other = replace(images[0], object_class=classes)
    plain, one = reconstruct(trained, [images[0], other])
    assert [item.label for item in one.scene.objects] == [names[index] for index in classes]
    assert set(one.taken_for) - set(plain.taken_for) == {"sofa"}
    assert one.taken_for["sofa"] in generated


def test_layout_losses_of_rooms_are_those_of_their_decoded_scenes(trained, toy_shards):
    views = as_views(images_of_split(toy_shards, "train", 0)[0], 4)
    losses = layout_losses_of_rooms(trained, views)
    assert losses.shape == (12, 12)
    room = 5
    first = rows_of(views, torch.tensor([room]))
    own = trained.prior.latent_space(trained.logits[3:4])
    scenes = replace(decode_images(trained, own, first), vertices_m=None)
    assert_close(
        losses[room, 3], view_loss(trained, scenes, first, masks=False).score[0],
        rtol=1e-4, atol=1e-5,
    )  # fmt: skip
