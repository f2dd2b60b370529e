"""Where scenes end: targets written out, and decisions that undo them."""

import pytest
import torch

from sceneprior.config import LossConfig
from sceneprior.losses.completeness import completeness_targets, kept_objects

CONVENTIONS = LossConfig.model_fields["completeness_target"].annotation.__args__


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


def test_a_score_of_one_half_is_not_above_it():
    assert kept_objects(torch.zeros(1, 3)).sum() == 0
    assert kept_objects(torch.zeros(1, 3), "stop").all()


def test_only_the_stop_convention_cannot_say_that_a_room_is_empty():
    none = torch.tensor([0])
    for convention, kept in (("first_n", 0), ("stop", 1)):
        logits = completeness_targets(none, 4, convention).float() * 2 - 1
        assert kept_objects(logits, convention).sum() == kept
