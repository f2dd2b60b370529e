"""Settings of the lifted method: the stages that they make."""

import warnings

import pytest
from tiny_runs import tiny_lifted

from sceneprior.core.errors import InputWarning


def test_few_training_rooms_are_warned_of(toy_shards, monkeypatch):
    stage = tiny_lifted(toy_shards).stages()[0]
    rooms = stage.open_data()
    count = len(rooms.plain_ids)
    with pytest.warns(InputWarning, match=f"only {count} rooms, so new rooms will be implausible"):
        stage.build(rooms, None)
    monkeypatch.setattr("sceneprior.lifted.config.FEW_ROOMS", count)
    with warnings.catch_warnings():
        warnings.simplefilter("error", InputWarning)
        stage.build(rooms, None)
