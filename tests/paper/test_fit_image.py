"""Fitting latents: RMSProp as PyTorch has it, image by image, until nothing moves."""

from dataclasses import replace

import pytest
import torch
from refusals import refused
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.core.views import as_views, images_of_split
from sceneprior.paper import fit_image
from sceneprior.paper.fit_image import (
    FitSchedule,
    decode_images,
    fit_latents_to_images,
    refuse_crowds,
    view_loss,
)

SHORT = FitSchedule(steps=12, drop_at=8, patience=0)


@pytest.fixture(scope="module")
def views(toy_shards):
    return as_views(images_of_split(toy_shards, "test", 0)[0], 4)


@pytest.fixture(scope="module")
def start(trained, views):
    return trained.prior.latent_space(trained.logits[:1]).expand(len(views.is_object), -1)


def by_pytorch(trained, views, start, schedule):
    """The schedule in PyTorch's own words; the best of what it passes through."""
    x = start.clone().requires_grad_()
    optimizer = torch.optim.RMSprop([x], lr=schedule.learning_rate)
    drop = torch.optim.lr_scheduler.MultiStepLR(optimizer, [schedule.drop_at], schedule.decay)
    passed, scores = [], []
    for _ in range(schedule.steps):
        loss = view_loss(trained, decode_images(trained, x, views), views)
        passed.append(x.detach().clone())
        scores.append(loss.score)
        optimizer.zero_grad()
        loss.total.sum().backward()
        optimizer.step()
        drop.step()
    best = torch.stack(scores).argmin(dim=0)
    return F.normalize(torch.stack(passed)[best, torch.arange(len(start))], dim=1)


def test_it_is_pytorchs_rmsprop_with_the_papers_drop(trained, views, start):
    fit = fit_latents_to_images(trained, views, start, SHORT)
    assert_close(fit.z, by_pytorch(trained, views, start, SHORT), rtol=1e-4, atol=1e-5)
    assert_close(fit.z.norm(dim=1), torch.ones(len(start)), rtol=1e-6, atol=0)
    assert fit.steps.tolist() == [12] * len(start)


def test_images_that_do_not_move_stop_early_and_others_go_on(trained, views, start):
    hopeless = FitSchedule(steps=60, drop_at=50, patience=20, least_gain=2.0)
    fit = fit_latents_to_images(trained, views, start, hopeless)
    # Nothing gains 200%: down at the first check, done at the second.
    assert fit.steps.tolist() == [40] * len(start)


def test_masks_without_a_number_are_told_at_once(trained, views, start, monkeypatch):
    mask_loss = fit_image.mask_loss

    def poisoned(*args, **settings):
        loss, overlap = mask_loss(*args, **settings)
        return loss * torch.nan, overlap

    monkeypatch.setattr(fit_image, "mask_loss", poisoned)
    with pytest.raises(FloatingPointError, match=r"The loss is nan on rooms "):
        fit_latents_to_images(trained, views, start, replace(SHORT, steps=1))


def test_more_objects_than_the_prior_generates(trained, views):
    many = torch.arange(7) % views.is_object.shape[1]
    of_objects = ("boxes", "visible", "sides_clear")
    crowded = replace(
        views,
        object_class=views.object_class[:, many],
        is_object=torch.ones(4, 7, dtype=torch.bool),
        **{name: getattr(views, name)[:, :, many] for name in of_objects},
    )
    with refused("paper/more objects than generated"):
        refuse_crowds(trained, crowded)
