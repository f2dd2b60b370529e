"""Contents of rooms: lists of classes, and the inputs on which they depend."""

import pytest
import torch
from torch.testing import assert_close

from sceneprior.lifted.sampler.contents import END, Contents, exclusive

CLASSES, SLOTS = 5, 4


@pytest.fixture
def contents(torch_rng) -> Contents:
    """A model of four classes, one of which is unknown."""
    found = Contents(CLASSES, 16, 0.0).eval()
    found.most[[END, 1, 2, 4]] = SLOTS
    return found


@torch.no_grad()
def test_likelihoods_are_those_of_one_class_after_the_other(contents):
    contents = contents.double()
    labels = torch.tensor([[1, 2, 1], [4, 0, 0], [0, 0, 0]])
    extents_m = torch.tensor([[3.0, 4.0], [2.0, 2.0], [5.0, 1.0]]).double()
    fast = contents.negative_log_likelihood(labels, labels > 0, extents_m)
    for row, listed in enumerate(([1, 2, 1], [4], [])):
        slow = 0.0
        for step in range(len(listed) + 1):
            counts = torch.tensor(listed[:step], dtype=torch.int64).bincount(minlength=CLASSES)
            logits = contents(counts.double(), extents_m[row]).log_softmax(dim=-1)
            slow -= float(logits[(*listed, END)[step]])
        assert slow == pytest.approx(float(fast[row]), rel=1e-9)


def test_lists_are_drawn_as_the_network_says(contents):
    """Far more rooms than can hang on luck: shares of lists are their probabilities."""
    count = 20_000
    uniform = torch.rand(count, SLOTS, generator=torch.Generator().manual_seed(0))
    extents_m = torch.tensor([[3.0, 4.0]]).expand(count, -1)
    there = torch.zeros(count, CLASSES)
    drawn = contents.draw(there, torch.full((count,), SLOTS), extents_m, uniform)
    assert not (drawn == 3).any(), "nobody knows this class"
    ended = (drawn == END).cumsum(dim=1) > 0
    assert not (drawn * ended).any(), "a list has one end"
    for listed in ([1], [2, 4], [4, 4, 1]):
        padded = torch.tensor([*listed, *[END] * (SLOTS - len(listed))])
        share = (drawn == padded).all(dim=1).float().mean()
        label = torch.tensor([listed])
        likely = contents.negative_log_likelihood(label, label > 0, extents_m[:1])
        assert_close(share, (-likely[0]).exp(), atol=0.01, rtol=0)


def test_no_room_has_more_of_a_class_or_of_rivals_than_training_rooms(contents):
    """Beds of two kinds are rivals; of the third class, rooms have two at most."""
    rooms = torch.zeros(40, CLASSES)
    rooms[:20, 1], rooms[20:, 2], rooms[:, 4] = 1, 1, torch.arange(40) % 3
    contents.teach(rooms)
    uniform = torch.rand(2000, 9, generator=torch.Generator().manual_seed(1))
    there, size_m = torch.zeros(2000, CLASSES), torch.full((2000, 2), 3.0)
    listed = contents.draw(there, torch.full((2000,), 9), size_m, uniform)
    counts = torch.nn.functional.one_hot(listed, CLASSES).sum(dim=1)
    assert counts[:, 1:].amax(dim=0).tolist() == [1, 1, 0, 2]
    assert not (counts[:, 1] * counts[:, 2]).any()
    asked = contents.draw(
        there, torch.full((2000,), 9), size_m, uniform, torch.tensor([9.0] * 4 + [0])
    )
    assert not (asked == 4).any(), "at most none is asked for"


def test_kinds_that_no_room_has_together_exclude_each_other():
    """Kinds 0 and 1 could not be apart by luck; kind 2 is too rare to say, and of kind 3 there are
    two in a room."""
    counts = torch.zeros(40, 4)
    counts[:20, 0], counts[20:, 1], counts[0, 2], counts[::2, 3] = 1, 1, 1, 2
    found = exclusive(counts)
    expected = torch.zeros(4, 4, dtype=torch.bool)
    expected[0, 1] = expected[1, 0] = expected[0, 0] = expected[1, 1] = True
    assert torch.equal(found, expected)
