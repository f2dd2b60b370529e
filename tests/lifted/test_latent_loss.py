"""The distance of training latents to drawn ones: its slow twin, gradients, what it ignores."""

import torch
from scipy.optimize import linear_sum_assignment
from torch.nn import functional as F
from torch.testing import assert_close

from sceneprior.lifted.losses import latent_loss, sliced_wasserstein


def points(rows, columns, seed):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(rows, columns, generator=generator, dtype=torch.float64)


def test_the_distance_on_each_line_is_that_of_the_cheapest_assignment():
    some, others = points(9, 4, 0) * 2, points(9, 4, 1) + 1
    directions = F.normalize(points(4, 5, 2), dim=0)
    cheapest = []
    for line in directions.T:
        cost = (some @ line)[:, None].sub((others @ line)[None]).square().numpy()
        cheapest.append(cost[linear_sum_assignment(cost)].mean())
    expected = torch.tensor(cheapest).mean()
    assert_close(sliced_wasserstein(some, others, directions), expected.double())


def test_gradients_are_right():
    some, others, directions = points(6, 3, 0), points(6, 3, 1), points(3, 4, 2)
    assert torch.autograd.gradcheck(
        lambda x: sliced_wasserstein(x, others, directions), some.requires_grad_()
    )


def test_what_the_sphere_does_not_see_counts_for_nothing():
    logits, shift = points(20, 7, 0), points(20, 1, 1)

    def loss(of, shift_free):
        return latent_loss(of, shift_free, torch.Generator().manual_seed(3))

    assert_close(loss(logits + shift, True), loss(logits, True))
    assert loss(logits + shift, False) > 1.5 * loss(logits, False)
