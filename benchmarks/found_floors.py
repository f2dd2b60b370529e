"""Accuracy of floors, walls and doors found from masks.

    python benchmarks/found_floors.py SHARDS [--split test] [--noisy] [--homes HOMES]

The shards must hold stuff and 3D ground truth, like those of `prep-front`. A wall's error is the
larger distance of its ends from the line through the nearest true side. A true side counts as found
if walls cover half of it. `--homes` is the folder of the houses, for the true doors; a door is
found if both ends are within 15 cm. With `--noisy`, each pose is displaced by 1 cm and 0.5 degrees,
and corrected from the masks of objects as by `prep-posed`; the outlines of floors and walls are
displaced by a standard deviation of one pixel in images with 240 pixels along the longer side.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from scipy import ndimage
from tracks import NOISES, moved, observed, rooms

from data_prep.front.furnished import ModelBank
from data_prep.front.houses import house_files, read_house
from data_prep.front.recipe import load_recipe
from sceneprior.core.observations import RoomViews
from sceneprior.core.wall_lines import Door, Wall, find_walls, seen_floor

NEAR_M = 0.05
DOOR_M = 0.15
WAVER_PX, WAVE_PX = 1.0, 6.0


class Score(NamedTuple):
    """Scores of one room."""

    seen: float
    """Share of the true floor that some view shows."""
    beyond_m2: float
    """Area of the seen floor outside the true floor."""
    walls: int
    errors_m: tuple[float, ...]
    stated_m: tuple[float, ...]
    """Standard errors that the found walls state themselves."""
    sides: int
    sides_found: int
    doors: int
    doors_true: int
    doors_found: int
    seconds: float


def score(views: RoomViews, floor_m: np.ndarray, doors: list[np.ndarray]) -> Score:
    """Find a room's floor, walls and doors, and compare them with the ground truth."""
    start = time.process_time()
    seen, (walls, found_doors) = seen_floor(views), find_walls(views)
    seconds = time.process_time() - start
    true = shapely.Polygon(floor_m)
    sides = np.stack([floor_m, np.roll(floor_m, -1, axis=0)], axis=1)
    sides = sides[np.linalg.norm(sides[:, 1] - sides[:, 0], axis=1) > 0.3]
    return Score(
        seen.intersection(true).area / true.area,
        seen.difference(true).area,
        len(walls),
        tuple(_error(wall, sides) for wall in walls),
        tuple(wall.error_m for wall in walls),
        len(sides),
        sum(_covered(side, walls) > 0.5 for side in sides),
        len(found_doors),
        len(doors),
        sum(any(_same(door, ends) for door in found_doors) for ends in doors),
        seconds,
    )


def _error(wall: Wall, sides: np.ndarray) -> float:
    """Distance of a wall's ends from the line of the nearest true side that passes the wall's
    middle; infinite if there is none."""
    along = sides[:, 1] - sides[:, 0]
    length = np.linalg.norm(along, axis=1)
    along /= length[:, None]
    ends = np.stack([wall.start_m, wall.end_m])
    place = ((ends.mean(axis=0) - sides[:, 0]) * along).sum(axis=1)
    beside = (np.abs(along @ wall.inward) < 0.2) & (place > 0) & (place < length)
    normals = np.stack([-along[:, 1], along[:, 0]], axis=1)
    away = np.abs(np.einsum("esk,sk->es", ends[:, None] - sides[:, 0], normals)).max(axis=0)
    return float(min(away[beside], default=np.inf))


def _covered(side: np.ndarray, walls: tuple[Wall, ...]) -> float:
    """Share of a side along which a wall was found."""
    line = shapely.LineString(side)
    there = [shapely.LineString([wall.start_m, wall.end_m]).buffer(NEAR_M) for wall in walls]
    return line.intersection(shapely.union_all(there)).length / line.length


def _same(door: Door, ends: np.ndarray) -> bool:
    mine = np.stack([door.start_m, door.end_m])
    away = [np.linalg.norm(mine - order, axis=1).max() for order in (ends, ends[::-1])]
    return min(away) < DOOR_M


def true_doors(homes: Path | None) -> dict[str, list[np.ndarray]]:
    """Ends of the base of each door, by room id."""
    if homes is None:
        return {}
    bank, recipe = ModelBank(homes / "3D-FUTURE-model"), load_recipe("bedroom")
    found = {}
    for path in house_files(homes / "3D-FRONT"):
        for room in read_house(path, bank, recipe, load_models=False).rooms:
            corners = room.shell.get("door", np.zeros((0, 3, 3))).reshape(-1, 3)
            base = corners[corners[:, 1] < 0.01][:, [0, 2]]
            found[room.room_id] = (
                [np.stack([base.min(axis=0), base.max(axis=0)])] if len(base) else []
            )
    return found


def spoilt(views: RoomViews, seed: int) -> RoomViews:
    """A room with displaced poses and ragged floors and walls, after the corrections of
    `prep-posed`."""
    assert views.stuff is not None and views.instance_ids is not None
    rng = np.random.default_rng(seed)
    poses = np.stack(
        [moved(pose, NOISES["noisy"], rng) for pose in views.world_to_camera.astype(np.float64)]
    )
    number, *places = np.indices(views.stuff.shape)
    moves = []
    for place, side in zip(places, views.stuff.shape[1:], strict=True):
        field = ndimage.gaussian_filter(rng.normal(size=views.stuff.shape), (0, WAVE_PX, WAVE_PX))
        moved_to = place + np.rint(WAVER_PX * field / field.std()).astype(int)
        moves.append(np.clip(moved_to, 0, side - 1))
    seen = observed(views, views.instance_ids.astype(np.int64), views.object_class, poses)
    return replace(seen, stuff=views.stuff[number, *moves])


def rows(scores: list[Score]) -> Iterator[str]:
    """Rows of the table: rooms by the share of the floor that is seen, and all rooms."""
    for name, low, high in (
        ("over 80% seen", 0.8, 2),
        ("50 to 80%", 0.5, 0.8),
        ("less", -1, 0.5),
        ("all", -1, 2),
    ):
        chosen = [each for each in scores if low <= each.seen < high]
        if not chosen:
            continue
        errors = np.array([error for each in chosen for error in each.errors_m])
        stated = np.array([error for each in chosen for error in each.stated_m])
        worst_cm = np.quantile(errors, 0.95, method="higher") * 100
        sums = {key: sum(getattr(each, key) for each in chosen) for key in Score._fields[5:10]}
        yield (
            f"| {name} ({len(chosen)}) | {np.mean([each.seen for each in chosen]):.2f} "
            f"| {np.mean([each.beyond_m2 for each in chosen]):.3f} "
            f"| {np.median(errors) * 100:.1f}, {worst_cm:.1f} "
            f"| {np.mean(errors <= NEAR_M):.3f} | {np.median(stated) * 100:.1f} "
            f"| {sums['sides_found']} / {sums['sides']} "
            f"| {sums['doors_found']} / {sums['doors_true']} ({sums['doors']}) "
            f"| {np.mean([each.seconds for each in chosen]):.2f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("shards", type=Path)
    parser.add_argument("--split", default="test")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--rooms", type=int, default=999)
    parser.add_argument("--noisy", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--homes", type=Path)
    parser.add_argument("--each", action="store_true", help="print every room")
    options = parser.parse_args()
    doors = true_doors(options.homes)
    scores = []
    chosen = rooms(options.shards, options.split, options.first, options.rooms)
    for place, (views, truth) in enumerate(chosen):
        views = spoilt(views, 1000 * options.seed + place) if options.noisy else views
        scores.append(score(views, truth.floor_m, doors.get(views.room_id, [])))
        if options.each:
            print(place, views.room_id, scores[-1], flush=True)
    print(
        "| rooms | seen | beyond, m2 | "
        "| wall error, 95%, cm | within 5 cm | stated, cm | sides | doors (found) | s |"
    )
    print("| --- " * 9 + "|")
    print("\n".join(rows(scores)))


if __name__ == "__main__":
    main()
