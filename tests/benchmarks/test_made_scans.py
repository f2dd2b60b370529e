"""`benchmarks/made_scans.py`: `prep-scannet` reads the made homes back from their scans."""

import contextlib
import io
import sys
from pathlib import Path

import made_scans
import numpy as np
import pytest
import shapely
from handheld import EYE_M, walk
from made_scans import (
    BEND_M,
    BORDER_M,
    DRIFT,
    NOISE_M,
    RAGGED,
    MadeScan,
    overlaps,
    ragged,
    rooms,
    scanned,
    swayed,
)
from scan_files import BOX_FACES, Box, ScanFolder

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
    build_shards(Job(source, path / "shards", workers=1))
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


def test_the_last_row_is_the_mean_of_all_objects(folder: Path, scans, labels):
    every = [iou for scan in scans for each in overlaps(scan, labels).values() for iou in each]
    assert np.mean(every) > 0.6
    lines = (folder / "printed.txt").read_text().splitlines()
    assert lines[0].startswith("1 training and 1 test rooms, ")
    assert lines[-1].startswith(f"| all | {len(every)} | {np.mean(every):.3f} | ")


def test_the_camera_stays_in_the_room_and_out_of_furniture(homes):
    for number, (room, _) in enumerate(homes):
        poses = walk(room, np.random.default_rng(number))
        assert len(poses) == 8 * len(room.furniture)
        eyes = np.array([pose[:3, 3] for pose in poses])
        assert np.abs(eyes[:, 1] - EYE_M).max() < 0.2
        assert all(room.floor.contains(shapely.Point(x, z)) for x, _, z in eyes)
        for piece in room.furniture:
            low, high = piece.mesh.vertices_m.min(axis=0), piece.mesh.vertices_m.max(axis=0)
            assert not ((eyes > low) & (eyes < high)).all(axis=1).any()


def test_poses_sway_by_the_given_root_mean_square(rng: np.random.Generator):
    moved = np.array(swayed([np.eye(4)] * 20_000, *DRIFT, rng))
    turns = np.degrees(
        np.arccos(((np.trace(moved[:, :3, :3], axis1=1, axis2=2) - 1) / 2).clip(-1, 1))
    )
    steps = np.linalg.norm(moved[:, :3, 3], axis=1)
    assert np.sqrt((turns**2).mean()) == pytest.approx(DRIFT[0], rel=0.1)
    assert np.sqrt((steps**2).mean()) == pytest.approx(DRIFT[1], rel=0.1)
    x = moved[:, 0, 3]
    assert np.corrcoef(x[1:], x[:-1])[0, 1] == pytest.approx(0.9, abs=0.03)


def test_only_borders_are_ragged(rng: np.random.Generator):
    points = rng.uniform((0.2, 0, 0), (0.3, 0.5, 0.5), (1500, 3))
    owner = (points[:, 0] > 0.25).astype(int)
    after = ragged(points, owner, rng)
    # The slow, obvious way.
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    at_border = ((distances < BORDER_M) & (owner[:, None] != owner)).any(axis=1)
    assert not (after != owner)[~at_border].any()
    assert (after != owner)[at_border].mean() == pytest.approx(RAGGED, abs=0.04)


def test_hidden_surfaces_are_not_fused(tmp_path: Path, rng: np.random.Generator):
    """The front of a box, which faces the camera, is kept, and nothing of the box behind it."""
    boxes = [Box("bed", (-1, 0, 0), (1, 1, 1)), Box("chair", (-0.5, 2, 0), (0.5, 3, 1))]
    scan = MadeScan(tmp_path / "scene0000_00", boxes, np.eye(4))
    _, scan.faces, _ = ScanFolder(tmp_path, boxes, np.eye(4)).mesh
    scan.vertices, scan.owner = np.concatenate([box.corners for box in boxes]), np.repeat([0, 1], 8)
    scan.look((0, -2, 0.5), (0, 0, 0.5))
    scan.true_poses, scan.poses = scan.poses, []
    scan.fuse(rng)
    assert len(scan.vertices) == 4 and len(scan.faces) == 2 < len(BOX_FACES)
    assert (scan.owner == 0).all()
    assert np.abs(scan.vertices[:, 1]).max() < BEND_M + 5 * NOISE_M
    # What was never seen has no box, and counts as 0.
    scan.poses = scan.true_poses
    scan.write((121, 162))
    labels = made_scans.write_labels(tmp_path / "labels.tsv", load_recipe("bedroom"))
    assert overlaps(scan, labels)["chair"] == [0.0]
