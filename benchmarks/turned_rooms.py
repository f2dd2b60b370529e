"""Error of the direction found in rotated rooms, and IoU of boxes lifted with and without it.

Run `python benchmarks/turned_rooms.py SHARDS ... [--noise 0 1]`. The shards must hold 3D ground
truth in rooms whose walls are aligned with the axes, like those of `prep-front`. Each room is
turned by a random angle; the noise is the same as in tracks.py, but ids are those of the true
objects. `--pieces` measures furniture at an angle to the walls instead.
"""

import argparse
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import shapely
import trimesh
from tracks import NOISES, ideal_ids, rooms, shuffled

from data_prep.readers.heading import find_turn, turn_matrix
from sceneprior.core.boxes import yaw_rotation
from sceneprior.core.observations import observe
from sceneprior.core.shards import MODELS_FOLDER, RoomGroundTruth, RoomViews
from sceneprior.lifted.lifting.boxes import lift_boxes

CORNERS = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
OFF_DEG = 10.0
"""Minimum angle to both axes at which a piece counts as turned."""


def iou_upright(
    centers: np.ndarray, sizes: np.ndarray, yaw: np.ndarray, others: tuple[np.ndarray, ...]
) -> np.ndarray:
    """IoU of n pairs of upright boxes: centres, sizes (n, 3), and yaws (n,) of both."""

    def footprints(centers: np.ndarray, sizes: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        turns = yaw_rotation(yaw)[:, ::2, ::2]
        return shapely.polygons((CORNERS * sizes[:, None, ::2]) @ turns.mT + centers[:, None, ::2])

    area = shapely.area(shapely.intersection(footprints(centers, sizes, yaw), footprints(*others)))
    ends = [
        (c[:, 1] - s[:, 1] / 2, c[:, 1] + s[:, 1] / 2) for c, s in ((centers, sizes), others[:2])
    ]
    (low, high), (other_low, other_high) = ends
    shared = area * np.maximum(np.minimum(high, other_high) - np.maximum(low, other_low), 0)
    return shared / (sizes.prod(axis=1) + others[1].prod(axis=1) - shared)


def turned(views: RoomViews, degrees: float) -> RoomViews:
    """The views, with the room turned about +y."""
    inverse = np.linalg.inv(turn_matrix(degrees))
    return replace(views, world_to_camera=(views.world_to_camera @ inverse).astype(np.float32))


def given(views: RoomViews, noisy: bool, seed: int) -> tuple[RoomViews, np.ndarray]:
    """Views with the noise of tracks.py and the ids of the true objects, and the rows of the true
    objects that are still visible."""
    frames = shuffled(views, NOISES["noisy" if noisy else "clean"], seed)
    ids, void = ideal_ids(frames.masks.ids, views), len(views.object_class) + 1
    seen = observe(np.where(ids < 0, void, ids).astype(np.uint32), [*views.object_class, 0])
    made = seen.room_views(views.room_id, frames.world_to_camera, views.intrinsics)
    return replace(made, stuff=views.stuff), seen.tracked


def lifted_iou(
    views: RoomViews, truth: RoomGroundTruth, rows: np.ndarray, yaw: float
) -> np.ndarray:
    """IoU of boxes lifted in a turned room with the true boxes, which are turned by `yaw`."""
    boxes, count = lift_boxes(views), len(rows)
    true = truth.centers_m[rows] @ yaw_rotation(yaw).T, truth.sizes_m[rows], np.full(count, yaw)
    return iou_upright(boxes.centers_m, boxes.sizes_m, np.zeros(count), true)


def score(
    views: RoomViews, truth: RoomGroundTruth, noisy: bool, lifts: bool, seed: int
) -> list[float]:
    """Errors in degrees from the masks of furniture, and from those of furniture and walls; NaN if
    no direction is found. Then, the mean IoU of boxes lifted in the unturned room, in the turned
    room, and in the room turned back by the direction found; NaN unless `lifts`."""
    made, rows = given(views, noisy, seed)
    angle = np.random.default_rng(seed).uniform(-45, 45)
    capture = turned(made, angle)
    found = [find_turn(replace(capture, stuff=None)), find_turn(capture)]
    errors = [np.nan if turn is None else abs((angle + turn + 45) % 90 - 45) for turn in found]
    if not lifts:
        return [*errors, *[np.nan] * 3]
    left = angle + (found[1] or 0.0)
    return errors + [
        float(lifted_iou(room, truth, rows, np.radians(yaw)).mean())
        for room, yaw in ((made, 0.0), (capture, angle), (turned(made, left), left))
    ]


def pieces(
    folder: Path, some: Iterable[tuple[RoomViews, RoomGroundTruth]]
) -> Iterator[tuple[float, ...]]:
    """For each tracked piece, the angle to the nearest axis in degrees, and the IoU of its oriented
    box with its true axis-aligned box, with its lifted box, and with the box lifted at its yaw."""
    for views, truth in some:
        count = len(views.object_class)
        aligned = lift_boxes(views)
        for k in range(count):
            yaw = float(truth.yaw_rad[k])
            off = abs((np.degrees(yaw) + 45) % 90 - 45)
            model: Any = trimesh.load(folder / MODELS_FOLDER / f"{truth.model_ids[k]}.ply")
            place = truth.model_to_room[k].astype(np.float64)
            points = (model.vertices @ place[:3, :3].T + place[:3, 3]) @ yaw_rotation(yaw)
            low, high = points.min(axis=0), points.max(axis=0)
            own = (low + high)[None] / 2 @ yaw_rotation(yaw).T, (high - low)[None], np.array([yaw])
            none = np.zeros(1)
            best, lifted = (
                iou_upright(c[k : k + 1], s[k : k + 1], none, own)[0]
                for c, s in ((truth.centers_m, truth.sizes_m), (aligned.centers_m, aligned.sizes_m))
            )
            with_yaw = lifted
            if off > OFF_DEG:
                other = lift_boxes(turned(views, -np.degrees(yaw)))
                center = other.centers_m[k : k + 1] @ yaw_rotation(yaw).T
                with_yaw = iou_upright(center, other.sizes_m[k : k + 1], own[2], own)[0]
            yield off, best, lifted, with_yaw


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("shards", type=Path, nargs="+")
    parser.add_argument("--split", default="test")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--noise", type=int, nargs="+", default=[0, 1])
    parser.add_argument(
        "--lifted", type=int, default=12, help="number of rooms in which boxes are lifted"
    )
    parser.add_argument("--pieces", action="store_true")
    options = parser.parse_args()
    for folder in options.shards:
        some = (folder, options.split, options.first, options.rooms)
        if options.pieces:
            table = np.array(list(pieces(folder, rooms(*some))))
            off = table[:, 0] > OFF_DEG
            print(f"| {folder.name} | {off.sum()} / {len(off)} | {off.mean():.1%}", end=" ")
            print(
                *(
                    f"| {x:.3f}"
                    for part in (table[off], table[~off])
                    for x in part[:, 1:4].mean(axis=0)
                ),
                "|",
            )
            continue
        for noisy in map(bool, options.noise):
            scores = np.array([
                score(views, truth, noisy, place < options.lifted, 1000 * seed + place)
                for seed in options.seeds
                for place, (views, truth) in enumerate(rooms(*some))
            ])  # fmt: skip
            print(f"| {folder.name} | {'noisy' if noisy else 'clean'}", end=" ")
            for errors in scores[:, :2].T:
                error = errors[~np.isnan(errors)]
                spread = f"{np.median(error):.2f} | {np.quantile(error, 0.9):.2f}"
                print(f"| {len(error)} / {len(errors)} | {spread} | {error.max():.2f}", end=" ")
            means = np.nanmean(scores[:, 2:], axis=0)
            print(*(f"| {mean:.3f}" for mean in means), "|", flush=True)


if __name__ == "__main__":
    main()
