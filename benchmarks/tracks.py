"""Accuracy of objects found from masks whose ids are inconsistent across frames.

Run `python benchmarks/tracks.py SHARDS ... [--noise clean noisy]`. The shards must hold 3D ground
truth, like those of `make-homes` and `prep-front`. Every frame gets new random ids. The noise,
drawn by the seed, removes 10% of the masks, merges 5% with the nearest mask of the same view, cuts
5% in two, gives 5% the class of another object, and displaces each pose by 1 cm and 0.5 degrees;
other names of `NOISES` are parts of it.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from data_prep.readers.corrected import correct
from data_prep.tracks.associate import FrameMasks, Tracks, associate
from sceneprior.core.boxes import box_iou_3d
from sceneprior.core.classes import VOID
from sceneprior.core.observations import RoomGroundTruth, RoomViews, observe
from sceneprior.core.shards import Shard, list_shards
from sceneprior.lifted.lifting.boxes import LiftedBoxes, lift_boxes
from sceneprior.lifted.lifting.hidden_sides import planes_of

UNKNOWN = -1
HEADER = (
    "| rooms | masks | ARI | least ARI | objects found / true | box IoU | with true ids | CPU s |\n"
    "| --- | --- | --- | --- | --- | --- | --- | --- |"
)


class Noise(NamedTuple):
    """Shares of the masks that are wrong, and the error of each pose."""

    missing: float = 0.0
    merged: float = 0.0
    cut: float = 0.0
    wrong_class: float = 0.0
    degrees: float = 0.0
    metres: float = 0.0


NOISES = {
    "clean": Noise(),
    "missing": Noise(missing=0.1),
    "merged": Noise(merged=0.05),
    "cut": Noise(cut=0.05),
    "moved": Noise(metres=0.01),
    "turned": Noise(degrees=0.5),
    "noisy": Noise(0.1, 0.05, 0.05, 0.05, 0.5, 0.01),
}


class Frames(NamedTuple):
    """Masks of single frames, and the poses given with them."""

    masks: FrameMasks
    world_to_camera: np.ndarray


def shuffled(views: RoomViews, noise: Noise, seed: int) -> Frames:
    """Give every mask of every view a unique id, in random order, after noise."""
    assert views.instance_ids is not None, "read with images"
    rng = np.random.default_rng(seed)
    void = len(views.object_class) + 1
    poses = views.world_to_camera.astype(np.float64)
    ids = np.zeros(views.instance_ids.shape, dtype=np.int32)
    classes: list[int] = []
    for view, image in enumerate(views.instance_ids.astype(np.int64)):
        class_of = {k + 1: int(name) for k, name in enumerate(views.object_class)}
        image, class_of = _spoilt(image, class_of, void, noise, rng)
        poses[view] = moved(poses[view], noise, rng)
        ids[view][image == void] = UNKNOWN
        numbers = [k for k in np.unique(image).tolist() if k not in (0, void)]
        for k in rng.permutation(numbers).tolist():
            classes.append(class_of[k])
            ids[view][image == k] = len(classes)
    return Frames(FrameMasks(ids, np.array(classes, dtype=np.int64)), poses)


def _spoilt(
    image: np.ndarray,
    class_of: dict[int, int],
    void: int,
    noise: Noise,
    rng: np.random.Generator,
) -> tuple[np.ndarray, dict[int, int]]:
    """An image of ids after masks are removed, merged and cut, and the ids' classes, some wrong."""
    image, class_of = image.copy(), dict(class_of)
    for k in _numbers(image, void):
        if rng.random() < noise.missing:
            image[image == k] = 0
    for k in _numbers(image, void):
        others = [other for other in _numbers(image, void) if other != k]
        if rng.random() < noise.merged and others and (image == k).any():
            far = ndimage.distance_transform_edt(image != k)
            nearest = min(others, key=lambda other: far[image == other].min())
            if (image == nearest).sum() > (image == k).sum():
                class_of[k] = class_of[nearest]
            image[image == nearest] = k
    for k in _numbers(image, void):
        if rng.random() < noise.cut:
            y, x = np.nonzero(image == k)
            angle = rng.uniform(0, np.pi)
            side = (x - x.mean()) * np.cos(angle) + (y - y.mean()) * np.sin(angle) > 0
            part = max(void, *class_of) + 1
            class_of[part] = class_of[k]
            image[y[side], x[side]] = part
    names = sorted(set(class_of.values()))
    for k in _numbers(image, void):
        if rng.random() < noise.wrong_class and len(names) > 1:
            class_of[k] = int(rng.choice([name for name in names if name != class_of[k]]))
    return image, class_of


def _numbers(image: np.ndarray, void: int) -> list[int]:
    return [k for k in np.unique(image).tolist() if k not in (0, void)]


def moved(pose: np.ndarray, noise: Noise, rng: np.random.Generator) -> np.ndarray:
    """The camera, rotated about a random axis and moved in a random direction."""
    axis, way = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    cross = np.cross(np.eye(3), axis)
    angle = np.radians(noise.degrees)
    change = np.eye(4)
    change[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    change[:3, 3] = noise.metres * way
    return change @ pose


class Score(NamedTuple):
    """Scores of one room."""

    rand: float
    """Adjusted Rand index over the pixels of given masks."""
    found: int
    true: int
    iou: float
    """Mean 3D IoU of true boxes with the lifted boxes of the objects found."""
    iou_true_ids: float
    """`iou` with ideal ids: each mask gets the id of the object with most of its pixels."""
    seconds: float


class Found(NamedTuple):
    """Objects found from the masks of single frames."""

    frames: Frames
    tracks: Tracks
    seconds: float


def find(views: RoomViews, noise: Noise, seed: int) -> Found:
    """Find the objects of one room from its masks, as `prep-posed --tracks auto` does."""
    frames = shuffled(views, noise, seed)
    start = time.process_time()
    tracks = associate(frames.masks, frames.world_to_camera, views.intrinsics)
    return Found(frames, tracks, time.process_time() - start)


def score(views: RoomViews, truth: RoomGroundTruth, found: Found) -> Score:
    """Compare the objects found in one room with the true objects."""
    assert views.instance_ids is not None
    (masks, poses), tracks = found.frames, found.tracks
    true, ids = views.instance_ids.astype(np.int64), masks.ids
    count = len(views.object_class)
    judged = (ids > 0) & (true > 0) & (true <= count)
    seen = observed(views, tracks.ids, tracks.object_class, poses)
    ideal = observed(views, ideal_ids(ids, views), views.object_class, poses)
    iou, iou_true_ids = (
        _mean_iou(lift_boxes(each, planes_of((), None)), truth, count) for each in (seen, ideal)
    )
    rand = rand_index(true[judged], np.maximum(tracks.ids[judged], 0))
    return Score(rand, len(seen.object_class), count, iou, iou_true_ids, found.seconds)


def ideal_ids(ids: np.ndarray, views: RoomViews) -> np.ndarray:
    """Images in which each mask of `shuffled` has the id of the true object with most of the mask's
    pixels."""
    assert views.instance_ids is not None
    true, count = views.instance_ids.astype(np.int64), len(views.object_class)
    judged = (ids > 0) & (true > 0) & (true <= count)
    table = np.zeros((int(ids.max()) + 1, count + 2), dtype=np.int64)
    np.add.at(table, (ids[judged], true[judged]), 1)
    return np.where(ids > 0, table.argmax(axis=1)[np.maximum(ids, 0)], ids)


def rand_index(a: np.ndarray, b: np.ndarray) -> float:
    """Adjusted Rand index of two labellings (Hubert and Arabie, 1985)."""
    if not len(a):
        return 1.0
    table = np.zeros((a.max() + 1, b.max() + 2))
    np.add.at(table, (a, b), 1)

    def pairs(counts: np.ndarray) -> float:
        return float((counts * (counts - 1) / 2).sum())

    rows, columns = pairs(table.sum(axis=1)), pairs(table.sum(axis=0))
    chance = rows * columns / pairs(np.array([len(a)]))
    most = (rows + columns) / 2
    return 1.0 if most == chance else (pairs(table) - chance) / (most - chance)


def observed(
    views: RoomViews, ids: np.ndarray, classes: np.ndarray, world_to_camera: np.ndarray
) -> RoomViews:
    """Views of the room as shards hold them, with other ids, classes and poses, after the
    corrections of `prep-posed`."""
    void = len(classes) + 1
    seen = observe(np.where(ids < 0, void, ids).astype(np.uint32), [*classes.tolist(), VOID])
    found = correct(seen, world_to_camera, views.intrinsics)
    if found.world_to_camera is not None:
        world_to_camera = found.world_to_camera
    made = found.seen.room_views(views.room_id, world_to_camera, views.intrinsics)
    return replace(made, stuff=views.stuff)


def _mean_iou(boxes: LiftedBoxes, truth: RoomGroundTruth, count: int) -> float:
    """Mean IoU of the true tracked objects with their assigned boxes; 0 for objects without a
    box."""
    near = truth.centers_m[:count], truth.sizes_m[:count]
    iou = box_iou_3d(boxes.centers_m, boxes.sizes_m, *near)
    return float(iou[linear_sum_assignment(-iou)].sum() / count)


def rooms(
    folder: Path, split: str, first: int, count: int
) -> Iterator[tuple[RoomViews, RoomGroundTruth]]:
    """`count` rooms of a split from room `first` on, in the order of the shards."""
    place = 0
    for path in list_shards(folder, split):
        with Shard(path) as shard:
            for name in shard.room_ids:
                if first <= place < first + count:
                    yield shard.read_room(name, images=True), shard.read_ground_truth(name)
                place += 1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("shards", type=Path, nargs="+")
    parser.add_argument("--split", default="test")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--noise", choices=NOISES, nargs="+", default=["clean", "noisy"])
    parser.add_argument("--each", action="store_true", help="print every room")
    options = parser.parse_args()
    print(HEADER)
    for folder in options.shards:
        for name in options.noise:
            scores = []
            for seed in options.seeds:
                for place, (views, truth) in enumerate(
                    rooms(folder, options.split, options.first, options.rooms)
                ):
                    found = find(views, NOISES[name], 1000 * seed + place)
                    scores.append(score(views, truth, found))
                    if options.each:
                        print(
                            place, views.room_id[:20], *(f"{x:.3f}" for x in scores[-1]), flush=True
                        )
            print(table_row(f"{folder.name} {options.split}", name, scores), flush=True)


def table_row(rooms: str, noise: str, scores: list[Score]) -> str:
    """Row of the table that begins with `HEADER`."""
    rand, found, true, iou, with_ids, seconds = np.array(scores).T
    return (
        f"| {rooms} ({len(scores)}) "
        f"| {noise} "
        f"| {rand.mean():.3f} | {rand.min():.3f} | {found.sum():.0f} / {true.sum():.0f} "
        f"| {iou.mean():.3f} | {with_ids.mean():.3f} "
        f"| {np.median(seconds):.2f}, at most {seconds.max():.2f} |"
    )


if __name__ == "__main__":
    main()
