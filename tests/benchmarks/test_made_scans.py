"""`benchmarks/made_scans.py`: `prep-scannet` reads the made homes back from their scans."""

import contextlib
import io
import sys
from pathlib import Path

import made_scans
import numpy as np
import pytest
from made_scans import (
    MadeScan,
    rooms,
    scanned,
)

from data_prep.engine.build import Job, build_shards
from data_prep.front.furnished import Room
from data_prep.front.recipe import load_recipe
from data_prep.homes.make import make_homes
from data_prep.readers.annotations import Labels, read_labels
from data_prep.readers.scannet import ScanNet
from sceneprior.core.classes import STUFF, label_set
from sceneprior.core.shards import Shard, list_shards


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two made homes, their scans, shards of these, and what was printed."""
    path = tmp_path_factory.mktemp("made")
    make_homes(path / "homes", 2, "bedroom", 0)
    out = path / "out"
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(io.StringIO()) as text:
        patch.setattr(sys, "argv", ["made_scans.py", str(path / "homes"), str(out)])
        made_scans.main()
    (path / "printed.txt").write_text(text.getvalue())
    lists = {name: out / f"{name}.txt" for name in ("train", "val")}
    source = ScanNet(out / "scans", labels=out / "labels.tsv", frame_step=1, **lists)
    build_shards(Job(source, path / "shards"))
    return path


@pytest.fixture(scope="module")
def homes(folder: Path) -> list[tuple[Room, str]]:
    """The rooms and their splits."""
    return list(rooms(folder / "homes", load_recipe("bedroom")))


@pytest.fixture(scope="module")
def scans(folder: Path, homes) -> list[MadeScan]:
    """The scans once more, with their true boxes and poses."""
    again = folder / "again"
    return [scanned(room, again / f"scene{k:04d}_00", k) for k, (room, _) in enumerate(homes)]


@pytest.fixture(scope="module")
def labels(folder: Path) -> Labels:
    return read_labels(folder / "out" / "labels.tsv")


def test_prep_scannet_finds_the_furniture_where_it_stands(folder: Path, homes, scans, labels):
    for (room, split), scan in zip(homes, scans, strict=True):
        (path,) = list_shards(folder / "shards", split)
        with Shard(path) as shard:
            views = shard.read_room(scan.folder.name, images=True)
            truth = shard.read_ground_truth(scan.folder.name)
        furniture = {k: b for k, b in enumerate(scan.boxes) if not labels.is_shell(b.category)}
        assert len(furniture) == len(room.furniture)
        classes = {k: labels.label(box.category) for k, box in furniture.items()}
        assert "bed" in classes.values()
        seen = [label_set("scannet")[k] for k in views.object_class]
        assert sorted(seen) == sorted(name for name in classes.values() if name != "void")
        assert {STUFF.index("floor"), STUFF.index("wall")} <= set(np.unique(views.stuff))
        size_of = dict(zip(truth.model_ids, truth.sizes_m, strict=True))
        wrong = [
            size_of[f"{scan.folder.name}_{k:03d}"] - np.ptp(furniture[k].corners, axis=0)[[1, 2, 0]]
            for k, name in classes.items()
            if name != "void"
        ]
        assert np.median(np.abs(wrong)) < 0.05
