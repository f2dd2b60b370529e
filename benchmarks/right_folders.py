"""False accusations of `inspect --verify`: captures without mistakes, and what is said of them.

Run `python benchmarks/right_folders.py OUT --seeds 0 100`. Each seed draws a folder of one to six
made rooms: bedrooms or living rooms, 6 to 40 views, the size and field of view of the pictures, the
tools that wrote poses and masks, and whether the floor's height is given. Half of the captures are
exact, the others have the noise of tracks.py. A folder is accused if `prep-posed` refuses it or
`inspect --verify` names a problem. Its shards stay in OUT, and are used again.
"""

import argparse
import re
import shutil
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tracks import NOISES, ideal_ids, shuffled

from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.homes.make import make_homes
from data_prep.inspection.causes import GIVEN
from data_prep.inspection.diagnosis import what_was_checked
from data_prep.inspection.verify import evidence_of, verify
from data_prep.readers.posed.reader import Posed
from sceneprior.core.classes import label_set
from sceneprior.core.errors import InputError
from sceneprior.core.observations import RoomViews
from sceneprior.core.shards import iterate_rooms, read_index

sys.path.append(str(Path(__file__).parents[1] / "tests" / "data_prep" / "readers"))

import capture_files as tools
from colmap_files import SCALE, write_colmap
from posed_files import PosedRoom, Thing

OPENGL = np.diag([1.0, -1, -1, 1])
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From y up to z up."""
MOST_ROOMS = 6
HOMES_FOR = 10
"""Number of seeds that take their houses from one folder of homes."""
SIZES = ((72, 96), (90, 120), (120, 160), (90, 160), (128, 96))

Writer = Callable[[PosedRoom], None]
POSES: dict[str, Writer] = {
    "nerfstudio": lambda room: None,
    "colmap": lambda room: write_colmap(room, "PINHOLE", binary=True),
    "polycam": tools.write_polycam,
    "record3d": tools.write_record3d,
}
TRACKED: dict[str, Writer] = {
    "png": lambda room: None,
    "sam2": lambda room: tools.write_sam2(room, hidden=False),
    "grounded-sam2": tools.write_grounded_sam2,
    "coco tracks": lambda room: tools.write_coco_images(room, "track_id"),
    "coco video": tools.write_coco_video,
}
UNTRACKED: dict[str, Writer] = {
    "png": lambda room: None,
    "grounded-sam2 images": tools.write_grounded_sam2_images,
    "coco images": tools.write_coco_images,
}


class Draw(NamedTuple):
    """One folder of captures."""

    kind: str
    rooms: int
    views: int
    size: tuple[int, int]
    fov_deg: int
    poses: str
    masks: str
    tracked: bool
    auto: bool
    """With --tracks auto."""
    noisy: bool
    floor: bool
    """The height of the floor is given."""


def draw(seed: int) -> Draw:
    """Draw what a folder has; small numbers of rooms and views are more frequent."""
    rng = np.random.default_rng([37, seed])
    tracked = bool(rng.random() < 0.6)
    masks = str(rng.choice([*(TRACKED if tracked else UNTRACKED)]))
    return Draw(
        str(rng.choice(["bedroom", "living"])), int(rng.integers(1, MOST_ROOMS + 1, 2).min()),
        int(rng.integers(6, 41, 2).min()), SIZES[rng.integers(len(SIZES))],
        int(rng.integers(55, 96)), str(rng.choice([*POSES])), masks, tracked,
        (masks == "png" and not tracked) or bool(rng.random() < 0.2), bool(rng.random() < 0.5),
        bool(rng.random() < 0.5),
    )  # fmt: skip


@dataclass
class Capture(PosedRoom):
    """A room whose masks are drawn already."""

    images: np.ndarray = field(default_factory=lambda: np.zeros((0, 1, 1), dtype=np.uint16))

    def __post_init__(self) -> None:
        self.size = self.images.shape[1], self.images.shape[2]

    def ids(self, view: int) -> np.ndarray:
        return self.images[view]


def capture(
    views: RoomViews, names: tuple[str, ...], drawn: Draw, seed: int, room: Path, scale: float
) -> None:
    """Write one room of shards as a user's capture; lengths come out `scale` times as long."""
    frames = shuffled(views, NOISES["noisy" if drawn.noisy else "clean"], seed)
    ids, class_of = frames.masks.ids, dict(enumerate(frames.masks.mask_class.tolist(), start=1))
    if drawn.tracked:
        ids, class_of = _tracked(ids, class_of, views)
    things = [Thing(k, names[index], (0,) * 3, (0,) * 3) for k, index in class_of.items()]
    unknown = max(class_of, default=0) + 1
    things.append(Thing(unknown, "backpack", (0,) * 3, (0,) * 3))
    images = np.where(ids < 0, unknown, ids).astype(np.uint16)
    rng = np.random.default_rng([seed, 1])
    angle = rng.choice([0.0, rng.uniform(0, 2 * np.pi)])
    world = np.eye(4)
    world[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    world[:2, 3] = rng.normal(size=2)
    poses = world @ Z_UP @ np.linalg.inv(frames.world_to_camera) @ OPENGL
    known = {"floor_m": 0.0} if drawn.floor else {}
    known |= {"metres_per_unit": scale} if scale != 1 else {}
    focal = float(views.intrinsics[0, 0, 0])
    made = Capture(room, things, focal_px=focal, poses=list(poses), images=images)
    made.write(**known)
    POSES[drawn.poses](made)
    if drawn.poses == "colmap":
        made.write_transforms({**known, "metres_per_unit": scale / SCALE})
    elif drawn.poses != "nerfstudio":
        made.write_transforms(known)
    (TRACKED if drawn.tracked else UNTRACKED)[drawn.masks](made)


def _tracked(
    ids: np.ndarray, class_of: dict[int, int], views: RoomViews
) -> tuple[np.ndarray, dict[int, int]]:
    """Ids of the true objects, and classes, for masks of single frames; of the parts of a mask that
    was cut, the smaller ones have an id of their own. An id has the class of its first mask."""
    true = ideal_ids(ids, views)
    tracked, classes = ids.copy(), dict[int, int]()
    new = len(views.object_class)
    for image, true_image, out in zip(ids, true, tracked, strict=True):
        numbers, first, counts = np.unique(image, return_index=True, return_counts=True)
        taken = set()
        for place in np.argsort(-counts, kind="stable"):
            if (number := int(numbers[place])) <= 0:
                continue
            k = int(true_image.flat[first[place]])
            if k in taken:
                new += 1
                k = new
            taken.add(k)
            out[image == number] = k
            classes.setdefault(k, class_of[number])
    return tracked, classes


def drawn_rooms(drawn: Draw, seed: int, homes: Path, out: Path) -> Path:
    """Shards of made rooms, which stay in `out`."""
    front = out / "front"
    if (front / "index.json").is_file():
        return front
    houses = out / "houses"
    shutil.rmtree(houses, ignore_errors=True)
    houses.mkdir(parents=True)
    first = seed % HOMES_FOR * MOST_ROOMS
    for path in sorted((homes / "3D-FRONT").iterdir())[first : first + drawn.rooms]:
        shutil.copy(path, houses)
    rules = (
        "views.per_m2=0.01", f"views.at_least={drawn.views}", "views.per_house_at_most=1000",
        f"views.image_size={[*drawn.size]}", f"views.fov_deg={drawn.fov_deg}",
        "views.min_object_pixels=20",
    )  # fmt: skip
    source = FrontSource(houses, homes / "3D-FUTURE-model", load_recipe(drawn.kind, rules))
    build_shards(Job(source, front, renderer="software"))
    shutil.rmtree(houses)
    return front


def make_shards(drawn: Draw, seed: int, homes: Path, out: Path, scale: float) -> Path:
    """Shards of a folder of captures, as `prep-posed` makes them."""
    shards = out / f"shards_{scale:g}"
    if (shards / "index.json").is_file():
        return shards
    front, captures = drawn_rooms(drawn, seed, homes, out), out / "captures"
    for folder in (captures, shards):
        shutil.rmtree(folder, ignore_errors=True)
    label_set_name = read_index(front)["label_set"]
    rooms = [
        shard.read_room(room_id, images=True)
        for split in ("train", "val", "test") if any((front / split).glob("*.h5"))
        for shard, room_id in iterate_rooms(front, split)
    ]  # fmt: skip
    for place, views in enumerate(rooms[: drawn.rooms]):
        room = captures / f"room{place}"
        capture(views, label_set(label_set_name), drawn, 100 * seed + place, room, scale)
    tracks = "auto" if drawn.auto else "given"
    build_shards(Job(Posed(captures, classes=label_set_name, tracks=tracks), shards))
    shutil.rmtree(captures)
    return shards


class Verdict(NamedTuple):
    """Result of one folder."""

    problems: tuple[str, ...]
    """The sentence of `prep-posed` that refuses the folder, or what `inspect --verify` finds."""
    fit: float = 0.0
    """Mean agreement of masks and cameras."""
    checked: bool = False
    """Some mistakes are excluded: the verdict is more than that little could be checked."""
    sized: bool = False
    """The scale could be checked."""

    @property
    def suggested(self) -> float | None:
        """The factor that the first sentence gives."""
        found = re.search(r"--metres-per-unit ([\d.]+(?:e-\d+)?)", " ".join(self.problems[:1]))
        return float(found[1]) if found else None


def verdict(drawn: Draw, seed: int, out: Path, scale: float) -> Verdict:
    """Make the folder, unless it is there, and verify it."""
    block = seed // HOMES_FOR
    homes = out.parent / f"{drawn.kind}_{block}"
    try:
        if not homes.is_dir():
            make_homes(homes, 2 * HOMES_FOR * MOST_ROOMS, drawn.kind, seed=1000 + block)
        found = verify(make_shards(drawn, seed, homes, out, scale))
    except InputError as error:
        return Verdict((f"refused: {error}",))
    evidence = evidence_of(found.every)
    assert evidence is not None, "rooms with sound arrays have evidence"
    checked = bool(what_was_checked(evidence)[0])
    return Verdict(found.problems, evidence.share(GIVEN), checked, evidence.scale is not None)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 100), metavar=("FIRST", "END"))
    parser.add_argument("--scale", type=float, default=1.0, help="a mistake: of all lengths")
    options = parser.parse_args()
    verdicts: list[Verdict] = []
    factors: list[float] = []
    of: dict[str, Counter[bool]] = {}
    start = time.process_time()
    for seed in range(*options.seeds):
        drawn = draw(seed)
        verdicts.append(found := verdict(drawn, seed, options.out / f"{seed:03d}", options.scale))
        tracks = "untracked" if drawn.auto or not drawn.tracked else "tracked"
        noise = "noisy" if drawn.noisy else "exact"
        for group in (drawn.kind, drawn.poses, drawn.masks, tracks, noise):
            of.setdefault(group, Counter())[bool(found.problems)] += 1
        said = f"ACCUSED: {' | '.join(found.problems)}" if found.problems else "-"
        print(seed, *drawn, f"{found.fit:.2f}", found.checked, found.sized, said, flush=True)
        factors += [factor * options.scale] if (factor := found.suggested) else []
    accused, checked, sized = (sum(map(bool, column)) for column in (
        [found.problems for found in verdicts], [found.checked for found in verdicts],
        [found.sized for found in verdicts],
    ))  # fmt: skip
    print(f"{accused} of {len(verdicts)} folders accused; in {checked} some mistakes are excluded")
    print(f"the scale could be checked in {sized}; {len(factors)} are told a metres_per_unit")
    if factors:
        off = np.exp(np.percentile(np.abs(np.log(factors)), [50, 90, 100]))
        print("off by a factor of {:.2f} in the median, {:.2f} (90%), {:.2f} at most".format(*off))
    print(f"least fit {min(found.fit for found in verdicts):.2f}")
    print("; ".join(f"{name} {counts[True]} of {counts.total()}" for name, counts in of.items()))
    print(f"{time.process_time() - start:.0f} CPU s")


if __name__ == "__main__":
    main()
