"""Scenes that another method may have made."""

from dataclasses import replace
from pathlib import Path

import pytest

from sceneprior.apps.rooms import write_scenes
from sceneprior.core.ground_truth import reference_scenes


@pytest.fixture(scope="session")
def scenes(toy_shards, tmp_path_factory) -> Path:
    """Four training rooms as boxes, in a folder. Tests read it and write scores beside them."""
    folder = tmp_path_factory.mktemp("theirs") / "scenes"
    rooms = reference_scenes(toy_shards, "train", limit=4)
    plain = [replace(room.without_meshes(), name=f"room_{k}") for k, room in enumerate(rooms)]
    write_scenes(plain, folder)
    return folder
