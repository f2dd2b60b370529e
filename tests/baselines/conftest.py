"""Finished runs of the baselines."""

from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_runs import tiny_baseline, tiny_config

from sceneprior.training.fit import fit
from sceneprior.training.method import RunConfig


@pytest.fixture(scope="session")
def baseline_config(toy_shards) -> Callable[..., RunConfig]:
    """Makes the config of a tiny run of a baseline; changes are written `training__epochs=2`."""

    def config(method: str, **changes) -> RunConfig:
        if method != "atiss2d":
            return tiny_baseline(toy_shards, method, **changes)
        decoder = {"name": "atiss2d", "heads": 2, "hidden": 24, "dropout": 0.1, "norm_first": False}
        settings = {"model__decoder": decoder, "layout__epochs": 3, "shape__epochs": 2}
        return tiny_config(toy_shards, **(settings | changes))

    return config


@pytest.fixture(scope="session")
def baseline_run(baseline_config, made_once) -> Callable[[str], Path]:
    """Trains a baseline once for all tests, which only read the run."""
    return lambda method: made_once(
        f"run_{method}",
        lambda run: fit(baseline_config(method), run, trainer_options={"accelerator": "cpu"}),
    )
