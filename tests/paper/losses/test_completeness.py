"""Completeness of scenes: targets written out, and decisions that invert them."""

import itertools

import pytest
import torch
from torch.testing import assert_close

from sceneprior.baselines.gan.semantic_maps import kept_share
from sceneprior.paper.losses import completeness_targets, kept_objects
from sceneprior.paper.prior import ModelConfig

CONVENTIONS = ModelConfig.model_fields["completeness_target"].annotation.__args__


def test_the_two_conventions_written_out():
    counts = torch.tensor([1, 3, 5])
    assert completeness_targets(counts, 5).int().tolist() == [
        [1, 0, 0, 0, 0], [1, 1, 1, 0, 0], [1, 1, 1, 1, 1],
    ]  # fmt: skip
    assert completeness_targets(counts, 5, "stop").int().tolist() == [
        [1, 1, 1, 1, 1], [0, 0, 1, 1, 1], [0, 0, 0, 0, 1],
    ]  # fmt: skip


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_scores_that_say_what_they_should_keep_the_real_objects(convention):
    counts = torch.arange(1, 8)
    logits = completeness_targets(counts, 7, convention).float() * 2 - 1
    assert torch.equal(kept_objects(logits, convention), torch.arange(7) < counts[:, None])


def test_the_first_word_counts():
    logits = torch.tensor([[2.0, 0.1, -0.1, 5.0], [-1, -2, 3, -1], [-1, -1, -1, -1]])
    assert kept_objects(logits).int().tolist() == [[1, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
    # Nobody says stop in the last room: it is as large as rooms can be.
    assert kept_objects(logits, "stop").int().tolist() == [[1, 0, 0, 0], [1, 1, 1, 0], [1, 1, 1, 1]]


def test_only_the_stop_convention_cannot_say_that_a_room_is_empty():
    none = torch.tensor([0])
    for convention, kept in (("first_n", 0), ("stop", 1)):
        logits = completeness_targets(none, 4, convention).float() * 2 - 1
        assert kept_objects(logits, convention).sum() == kept


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_the_share_kept_is_the_chance_that_a_scene_drawn_by_the_scores_goes_on(
    convention, torch_rng
):
    scores = torch.rand(2, 5, generator=torch_rng, dtype=torch.float64)
    share = kept_share(scores, convention)
    for room in range(2):
        wanted = torch.zeros(5, dtype=torch.float64)
        for words in itertools.product((0, 1), repeat=5):  # every way to say yes and no
            said = torch.tensor(words, dtype=torch.float64)
            chance = (said * scores[room] + (1 - said) * (1 - scores[room])).prod()
            wanted += chance * kept_objects(said[None] - 0.5, convention)[0]
        assert_close(share[room], wanted, rtol=0, atol=1e-12)
    inputs = scores[:, :3].requires_grad_()
    assert torch.autograd.gradcheck(lambda x: kept_share(x, convention), inputs)
