"""What the number of torch's threads changes: the last bits of gradients, and nothing else."""

import os
import subprocess
import sys
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from sceneprior.apps.config import load_config


@pytest.fixture
def step_on() -> Callable[[int], tuple[Tensor, list[Tensor]]]:
    """Boxes and gradients of 64 rooms at the small configs' size, on so many threads."""
    before = torch.get_num_threads()
    config = load_config("paper/bedroom_small.yaml", ("label_set=front3d_bedroom",))
    prior = config.build_prior()
    z = prior.latent_space(torch.randn(64, 100, generator=torch.Generator().manual_seed(0)))

    def step(threads: int) -> tuple[Tensor, list[Tensor]]:
        torch.set_num_threads(threads)
        scenes = prior.decode(z.detach(), with_shape=False)
        loss = scenes.class_logits.logsumexp(-1).mean() + (scenes.sizes_m - 1).square().mean()
        used = [*prior.decoder.parameters(), *prior.layout.parameters()]
        return scenes.sizes_m.detach(), list(torch.autograd.grad(loss, used))

    yield step
    torch.set_num_threads(before)


def test_a_step_is_the_same_on_two_threads_but_for_the_last_bits(step_on):
    one, again, two = step_on(1), step_on(1), step_on(2)
    assert torch.equal(one[0], again[0])
    assert all(map(torch.equal, one[1], again[1]))
    # Forward, no sum is shared among threads; sums over the batch are, in the backward pass.
    assert_close(two[0], one[0], rtol=0, atol=1e-6)
    for found, wanted in zip(two[1], one[1], strict=True):
        assert (found - wanted).norm() <= 1e-5 * wanted.norm()


def test_threads_wait_without_spinning_unless_the_user_says_otherwise():
    say = [sys.executable, "-c", "import sceneprior, os; print(os.environ['OMP_WAIT_POLICY'])"]
    for own, wanted in (({}, "PASSIVE"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "ACTIVE")):
        environment = {k: v for k, v in os.environ.items() if k != "OMP_WAIT_POLICY"} | own
        said = subprocess.run(say, capture_output=True, text=True, check=True, env=environment)
        assert said.stdout.strip() == wanted
