"""Scenes that another method may have made."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import pytest
from toy_metrics import without_classifiers

from sceneprior.apps.experiments import report as pages
from sceneprior.apps.rooms import write_scenes
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.evaluation import report


@pytest.fixture(scope="session")
def scenes(toy_shards, tmp_path_factory) -> Path:
    """Four training rooms as boxes, in a folder. Tests read it and write scores beside them."""
    folder = tmp_path_factory.mktemp("theirs") / "scenes"
    rooms = reference_scenes(toy_shards, "train", limit=4)
    plain = [replace(room.without_meshes(), name=f"room_{k}") for k, room in enumerate(rooms)]
    write_scenes(plain, folder)
    return folder


@pytest.fixture
def bare(toy_shards, tmp_path) -> Path:
    """The toy shards without their 3D ground truth."""
    folder = shutil.copytree(toy_shards, tmp_path / "bare")
    for path in folder.glob("*/*.h5"):
        with h5py.File(path, "a") as file:
            for group in file["rooms"].values():
                del group["ground_truth"]
    return folder


@pytest.fixture(autouse=True)
def no_classifier(monkeypatch: pytest.MonkeyPatch) -> None:
    """Evaluations in this process answer without classifiers, which take most of their time."""
    without_classifiers(monkeypatch)


@pytest.fixture(autouse=True)
def few_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Report pages show two rooms of each kind and one curve: pictures take most of their time."""
    for module in (report, pages):
        monkeypatch.setattr(module, "ROOMS_SHOWN", 2)
    monkeypatch.setattr(report, "DECODED_SHOWN", 2)
    monkeypatch.setattr(pages, "UNFOLDING_STEPS", 2)
    monkeypatch.setattr(pages, "CURVES", ("loss",))
