"""Completion: the loss against its definition, answers that hold what is given and differ."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch
from torch import nn

from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.views import DecodedScenes
from sceneprior.lifted.complete import (
    BOX_WEIGHT,
    _starts,
    complete,
    fit_latents_to_objects,
    gather_given,
    given_loss,
    log_kept,
    repeated,
)
from sceneprior.lifted.rooms import PosedRooms
from sceneprior.paper.latents import LatentSphere
from sceneprior.paper.losses import kept_objects
from sceneprior.paper.prior import ScenePrior
from sceneprior.paper.sampling import draw_latents

BED = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))
FEW = 20
"""Steps, where it does not matter how far they lead."""
DESK = SceneObject("desk", (1.5, 0.4, 1.3), (1.0, 0.8, 0.6))


def scene(*objects: SceneObject) -> Scene:
    return Scene("mine", "front3d_bedroom", objects)


def latents_of(rooms: list[Scene]) -> torch.Tensor:
    return torch.from_numpy(np.stack([room.latent for room in rooms]))


def random_decoded(rooms: int, predictions: int, seed: int = 0) -> DecodedScenes:
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    return DecodedScenes(
        draw(rooms, predictions, 5), draw(rooms, predictions, 3), draw(rooms, predictions, 3).exp(),
        draw(rooms, predictions),
    )  # fmt: skip


@pytest.mark.parametrize("target", ["first_n", "stop"])
def test_the_loss_is_its_definition(target):
    """All assignments tried, everything in words of one prediction and one object."""
    decoded = random_decoded(3, 4)
    labels = torch.tensor([[1, 2, 4], [3, 0, 0], [0, 0, 0]])
    is_object = torch.tensor([[True] * 3, [True, False, False], [False] * 3])
    boxes = torch.randn(3, 3, 6, dtype=torch.float64)
    losses = given_loss(decoded, PosedRooms(labels, is_object, boxes), target)
    for room in range(3):
        count = int(is_object[room].sum())
        expected = loss_in_words(decoded, room, labels[room, :count], boxes[room], target)
        torch.testing.assert_close(losses[room], expected)


def loss_in_words(decoded, room, labels, boxes, target):
    score = decoded.completeness_logits[room].sigmoid()
    chance = decoded.class_logits[room].softmax(dim=-1)
    predicted = torch.cat([decoded.centers_m[room], decoded.sizes_m[room]], dim=-1)

    def cost(predictions, of_class):
        total = torch.zeros((), dtype=torch.float64)
        for k, prediction in enumerate(predictions):
            kept = (
                score[: prediction + 1].prod()
                if target == "first_n"
                else (1 - score[:prediction]).prod()
            )
            total += BOX_WEIGHT * (predicted[prediction] - boxes[k]).abs().mean() - kept.log()
            total += of_class(chance[prediction, labels[k]])
        return total

    best = min(
        permutations(range(4), len(labels)), key=lambda predictions: cost(predictions, torch.neg)
    )
    return cost(best, lambda p: -p.log()) / max(len(labels), 1)


@pytest.mark.parametrize("target", ["first_n", "stop"])
def test_probability_of_being_kept_follows_decoding(target):
    logits = 50 * random_decoded(40, 6).completeness_logits
    kept = log_kept(logits, target).exp() > 0.5
    assert torch.equal(kept, kept_objects(logits, target))


def test_given_objects_are_in_every_answer_as_they_came(trained):
    given = scene(BED, DESK)
    rooms, others = complete(trained, [given, scene(DESK)], count=3, seed=1, steps=FEW)
    z = latents_of(rooms)
    assert z.shape == latents_of(others).shape == (3, 16)
    for room in rooms:
        assert [replace(item, mesh=None) for item in room.objects[:2]] == [BED, DESK]
        assert room.extra["given"] == [0, 1] and room.extra["seed"] == 1
        assert len(room.objects) >= 2
    assert all(replace(room.objects[0], mesh=None) == DESK for room in others)
    names = [room.name for room in rooms]
    assert names == ["complete_00", "complete_01", "complete_02"]
    # Answers differ from each other: no two latents alike.
    assert torch.pdist(z).min() > 1e-3
    # The same seed gives the same, alone or beside another room.
    (same,) = complete(trained, [given], count=3, seed=1, steps=FEW)
    torch.testing.assert_close(latents_of(same), z, rtol=0, atol=1e-4)
    assert [len(room.objects) for room in same] == [len(room.objects) for room in rooms]
    (elsewhere,) = complete(trained, [given], count=3, seed=2, steps=FEW)
    assert (latents_of(elsewhere) - z).abs().max() > 1e-3


def test_the_fit_comes_nearer_and_stays_on_the_sphere(trained):
    given = gather_given(trained, [scene(BED, DESK)])
    # Near training rooms: elsewhere a few steps are too few for a prior that is hardly trained.
    starts = _starts(trained, given, 4, 0, "kernel")
    each = repeated(given, 4)
    with torch.no_grad():
        before = given_loss(trained.prior.decode(starts, with_shape=False), each)
        drawn, _ = draw_latents(trained, 100, 0, "kernel")
        usual = given_loss(
            trained.prior.decode(drawn, with_shape=False), repeated(given, 100)
        ).mean()
    z, after = fit_latents_to_objects(trained, starts, each, FEW)
    assert (before < usual).all() and (before.diff() >= 0).all()  # chosen, best first
    assert (after < before).all()
    torch.testing.assert_close(z.norm(dim=1), torch.ones(4))
    assert not any(part.requires_grad for part in trained.prior.parameters())


class Dial(ScenePrior):
    """A bed 3 m from the middle, in the direction that the latent points to."""

    def __init__(self):
        nn.Module.__init__(self)
        self.latent_space = LatentSphere(4, 3)

    def decode(self, z, with_shape=True):
        logits = torch.zeros(len(z), 1, 22)
        logits[..., label_set("front3d_bedroom").index("double_bed")] = 50.0
        ones = torch.ones(len(z), 1)
        return DecodedScenes(
            logits, 3 * z.unsqueeze(1), ones.unsqueeze(-1).expand(-1, -1, 3), 50 * ones
        )


def test_the_fit_finds_the_one_latent_that_fits_and_is_held_by_its_start(trained, monkeypatch):
    dial = replace(trained, prior=Dial(), stage="layout")
    wanted = torch.tensor([2.0, -1.0, 2.0]) / 3
    bed = SceneObject("double_bed", tuple((3 * wanted).tolist()), (1.0, 1.0, 1.0))
    given = repeated(gather_given(dial, [scene(bed)]), 3)
    starts = torch.nn.functional.normalize(torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, -1, 1]]))
    monkeypatch.setattr("sceneprior.lifted.complete.START_WEIGHT", 0.0)
    z, left = fit_latents_to_objects(dial, starts, given)
    torch.testing.assert_close(z, wanted.expand(3, -1), rtol=0, atol=0.01)  # the last step's length
    torch.testing.assert_close(left, torch.zeros(3), rtol=0, atol=0.05)
    monkeypatch.setattr("sceneprior.lifted.complete.START_WEIGHT", 1000.0)
    z, _ = fit_latents_to_objects(dial, starts, given)
    torch.testing.assert_close(z, starts, rtol=0, atol=0.02)
    torch.testing.assert_close(fit_latents_to_objects(dial, starts, given, steps=0)[0], starts)


def test_nothing_given_is_what_the_run_generates(trained):
    (rooms,) = complete(trained, [scene()], count=2, seed=3, steps=FEW)
    torch.testing.assert_close(latents_of(rooms), draw_latents(trained, 256, 3)[0][:2])
    assert all(room.extra["given"] == [] and room.objects for room in rooms)


def test_what_cannot_be_given_is_a_sentence(trained):
    def said(*objects: SceneObject) -> str:
        with pytest.raises(InputError) as error:
            complete(trained, [scene(*objects)], count=1)
        return str(error.value)

    assert said(*[BED] * 7) == (
        "mine gives 7 objects, but rooms of this run hold at most 6 (model.max_objects); give "
        "fewer, or train with more."
    )
    assert "object 1 is a 'toilet', which this run does not know; its classes are" in said(
        BED, replace(BED, label="toilet")
    )
    assert "object 0 is a 'void'" in said(replace(BED, label="void"))
    assert "sizes above 0" in said(replace(BED, size_m=(1.0, 0.0, 1.0)))
    assert "Are these centimetres? Give metres." in said(replace(BED, size_m=(180.0, 60.0, 200.0)))
    assert "expected finite metres" in said(replace(BED, center_m=(0.0, np.inf, 1.0)))
    # As many as fit are no trouble.
    (rooms,) = complete(trained, [scene(*[BED] * 6)], count=1, steps=FEW)
    assert len(rooms[0].objects) >= 6
