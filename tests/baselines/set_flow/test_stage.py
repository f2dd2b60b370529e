"""The order in which noise is given to the objects of a training room."""

from itertools import permutations

import torch

from sceneprior.baselines.set_flow.stage import matched


def test_noise_goes_the_shortest_way_to_the_objects(torch_rng):
    noise = torch.randn(3, 4, 5, generator=torch_rng)
    tokens = torch.randn(3, 4, 5, generator=torch_rng)
    counts = [4, 2, 0]
    is_object = torch.arange(4) < torch.tensor(counts)[:, None]
    found = matched(noise, tokens, is_object)
    for room, count in enumerate(counts):
        ways = {
            order: float(((noise[room, list(order)] - tokens[room, :count]) ** 2).sum())
            for order in permutations(range(count))
        }
        best = min(ways, key=ways.get)
        assert torch.equal(found[room, :count], noise[room, list(best)])
