"""Shards of three kinds of data, and cameras of theirs as mistakes would have written them."""

import shutil

import h5py
import numpy as np
from front_jobs import change_room
from posed_files import PosedRoom, Thing, furniture
from scan_files import Box, make_scan, write_table

from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.homes.make import make_homes
from data_prep.readers.posed.reader import Posed
from data_prep.readers.scannet import ScanNet

OPENGL = np.diag([1.0, -1, -1, 1])


def homes(folder):
    """Four bedrooms made from a seed: meshes."""
    data = folder.parent / f"{folder.name}.data"
    make_homes(data, 4, "bedroom", seed=0)
    rules = ("views.per_m2=0.6", "views.image_size=[180, 240]", "views.min_object_pixels=60")
    source = FrontSource(data / "3D-FRONT", data / "3D-FUTURE-model", load_recipe("bedroom", rules))
    build_shards(Job(source, folder, renderer="software"))


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


def posed(folder, written=lambda poses: poses):
    """Four captures: masks and poses alone; `written` makes a mistake in transforms.json."""
    data = folder.parent / f"{folder.name}.data"
    for k in range(4):
        things = [*furniture(0.05 * k), Thing(9, "sofa", (-1.6, 1.4, 0.0), (-0.3, 2.0, 0.8))]
        room = PosedRoom(data / f"room_{k}", things, size=(192, 256), focal_px=150.0)
        for eye in [(0.3, 2.9, 1.6), (2.6, 0.2, 1.4), (-2.7, 0.4, 1.8)]:
            room.look(eye, (0.0, 0.2, 0.3))
        known = {"floor_m": 0.0, "floor_center_m": [0.0, 0.0]}
        room.write(**known)
        room.poses = list(written(np.stack(room.poses)))
        room.write_transforms(room.data | known)
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
