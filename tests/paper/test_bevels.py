"""Bevels of objects, and the losses from which they are learnt."""

import torch
from torch.testing import assert_close

from sceneprior.paper.layout_decoder import ClassBevels


def test_a_sure_class_has_its_own_chamfers_and_an_unsure_one_the_mean():
    table = ClassBevels(3)
    with torch.no_grad():
        table.logits.copy_(torch.tensor([[-2.0, 0], [0, 2], [3, -3]]))
    mixed = torch.tensor([[[0.0, 200, 0], [50, 50, -200]]])
    own = torch.sigmoid(torch.tensor([[0.0, 2], [-2, 0]]))
    half = (torch.tensor([0.5, torch.tensor(2.0).sigmoid()]) + own[1]) / 2
    assert_close(table(mixed)[0], torch.stack([own[0], half]))


def test_classes_learn_nothing_from_how_boxes_look():
    table, logits = ClassBevels(4), torch.randn(2, 3, 4, requires_grad=True)
    table(logits).sum().backward()
    assert logits.grad is None and table.logits.grad.abs().min() > 0
