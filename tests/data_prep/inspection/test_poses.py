"""Wrong cameras under right checksums: `inspect --verify` fails and names what is wrong.

The whole sentences are in tests/golden/data_prep/verified.json.
"""

import shutil

import h5py
import numpy as np
import pytest
from front_jobs import change_room, homes_shards
from golden_values import hold
from posed_files import PosedRoom, Thing, furniture
from scan_files import Box, make_scan, write_table

from data_prep.engine.build import Job, build_shards
from data_prep.inspection.causes import GIVEN
from data_prep.inspection.verify import agreement_of, evidence_of, verify
from data_prep.readers.posed.reader import Posed
from data_prep.readers.scannet import ScanNet

OPENGL = np.diag([1.0, -1, -1, 1])


def homes(folder):
    """Four bedrooms made from a seed: meshes."""
    rules = ("views.per_m2=0.6", "views.image_size=[180, 240]", "views.min_object_pixels=60")
    homes_shards(folder, 4, *rules)


def scans(folder):
    """Two scans of three pieces and a cupboard that hides what is behind it: 3D boxes alone."""
    data = folder.parent / f"{folder.name}.data"
    for name in ("scene0000_00", "scene0001_00"):
        scan = make_scan(data / name)
        scan.boxes.append(Box("couch", (0.4, 2.4, 0.05), (1.8, 3.1, 0.8)))
        for eye in [(4.5, 1.0, 1.5), (2.2, -2.6, 1.7), (-2.0, 1.5, 1.9)]:
            scan.look(eye, (1.7, 1.4, 0.5))
        scan.write(mask_size=(242, 324))
    source = ScanNet(data, labels=write_table(data / "labels.tsv"), frame_step=1)
    build_shards(Job(source, folder))


def posed(folder):
    """Four captures: masks and poses alone."""
    data = folder.parent / f"{folder.name}.data"
    for k in range(4):
        things = [*furniture(0.05 * k), Thing(9, "sofa", (-1.6, 1.4, 0.0), (-0.3, 2.0, 0.8))]
        room = PosedRoom(data / f"room_{k}", things, size=(192, 256), focal_px=150.0)
        for eye in [(0.3, 2.9, 1.6), (2.6, 0.2, 1.4), (-2.7, 0.4, 1.8)]:
            room.look(eye, (0.0, 0.2, 0.3))
        known = {"floor_m": 0.0, "floor_center_m": [0.0, 0.0]}
        room.write(**known)
    build_shards(Job(Posed(data, classes="void,bed,chair,sofa,backpack"), folder))


KINDS = {"homes": homes, "scans": scans, "posed": posed}


def mutated(folder, target, poses=lambda poses: poses, lenses=lambda lenses: lenses, rooms=None):
    """A copy of a folder of shards whose first `rooms` rooms, or all, have other cameras."""
    shutil.copytree(folder, target)
    left = rooms

    def change(group):
        for name, mistake in (("world_to_camera", poses), ("intrinsics", lenses)):
            group[name][...] = mistake(group[name][()].astype(np.float64))

    for path in sorted(target.glob("*/*.h5")):
        with h5py.File(path) as file:
            count = len(file["rooms"])
        for number in range(count)[:left]:
            change_room(path, change, number)
        left = left and max(0, left - count)
    return target


def scaled(factor):
    """Translations of another unit."""

    def change(poses):
        poses[:, :3, 3] *= factor
        return poses

    return change


def swapped(poses):
    poses[[1, 2]] = poses[[2, 1]]
    return poses


def longer(factor):
    """Other focal lengths under the same principal point."""

    def change(lenses):
        lenses[:, [0, 1], [0, 1]] *= factor
        return lenses

    return change


Z_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
WRONG = {
    "homes: inverted": {"poses": np.linalg.inv},
    "homes: opengl": {"poses": lambda poses: OPENGL @ poses},
    "homes: longer lens": {"lenses": longer(1.5)},
    "homes: next frames": {"poses": lambda poses: np.roll(poses, 1, axis=0)},
    "homes: z up": {"poses": lambda poses: poses @ Z_UP},
    "homes: larger": {"poses": scaled(1.3)},
    "homes: centimetres": {"poses": scaled(100)},
    "homes: two frames swapped in a room": {"poses": swapped, "rooms": 1},
    "scans: two frames swapped in a room": {"poses": swapped, "rooms": 1},
    "homes: one room inverted": {"poses": np.linalg.inv, "rooms": 1},
    "posed: 100 times": {"poses": scaled(100)},
    "posed: a tenth": {"poses": scaled(0.1)},
}


@pytest.fixture
def shards(made_once):
    """Kind of data -> a right folder of it, which tests only read."""
    return lambda kind: made_once(f"verified_{kind}", KINDS[kind])


@pytest.mark.parametrize("kind", KINDS)
def test_right_cameras_pass(shards, kind):
    found = verify(shards(kind))
    assert found.problems == ()
    evidence = evidence_of(found.every)
    assert evidence.share(GIVEN) > 0.75 or evidence.spare < 12
    if kind != "posed":
        (tally,) = agreement_of(found.every).values()
        # Also masks that something hides in part, and those at the image's border.
        assert tally.masks > 2 * tally.whole > 0 and tally.share == 1.0


@pytest.mark.parametrize("name", WRONG)
def test_wrong_cameras_are_named(shards, name, tmp_path):
    folder = mutated(shards(name.partition(":")[0]), tmp_path / "wrong", **WRONG[name])
    said = list(verify(folder).problems)
    hold("verified", {name: said}, slack=0.02, tmp=tmp_path)
