"""Seeds that no library takes are one sentence, wherever they are given."""

import pytest

import sceneprior
from sceneprior.apps.config import load_config
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.core.repeatable import LARGEST_SEED, check_seed
from sceneprior.core.scene import Scene

TWENTY_DIGITS = 10**20 - 1


@pytest.fixture(scope="module", params=["sampler_run", "toy_run"])
def prior(request):
    return sceneprior.load(request.getfixturevalue(request.param))


def test_a_seed_is_a_number_of_32_bits(prior):
    check_seed(0)
    check_seed(LARGEST_SEED)
    assert prior.sample(1, LARGEST_SEED)[0].name == f"seed{LARGEST_SEED}_0000"
    empty = Scene("empty", "front3d_bedroom")
    for seed in (-1, LARGEST_SEED + 1, TWENTY_DIGITS):
        said = rf"The seed is {seed}; expected a whole number from 0 to {LARGEST_SEED}\."
        with pytest.raises(InputError, match=said):
            prior.sample(1, seed)
        with pytest.raises(InputError, match=said):
            prior.complete(empty, 1, seed)
    with pytest.raises(InputError, match=f"The seed is {TWENTY_DIGITS}"):
        prior.latent(f"seed:{TWENTY_DIGITS}")


def test_configs_take_no_larger_one():
    with pytest.raises(ConfigError, match="seed"):
        load_config("demo.yaml", (f"seed={TWENTY_DIGITS}",))
