"""Scans of made homes in ScanNet's format, with the errors of real scans.

    python benchmarks/made_scans.py HOMES OUT [--recipe bedroom]
    sceneprior prep-scannet --scans OUT/scans --labels OUT/labels.tsv --train-list OUT/train.txt \
      --val-list OUT/val.txt --frame-step 1 --out SHARDS

HOMES is a folder of `make-homes`. A handheld camera walks over the free floor of each room and
pans to every object twice. The scan is the fused mesh: the surfaces that a frame saw, bent and
noisy, with ragged borders between objects. Masks show this mesh from the true poses; the written
poses drift, and some are lost. Test rooms are listed in val.txt, all others in train.txt. A table
compares the boxes that `prep-scannet` takes from the fused mesh with the true ones. Files are
written by the tests' writer.
"""

import argparse
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh
from handheld import swayed, walk
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from data_prep.engine.plan import read_splits
from data_prep.front.furnished import ModelBank, Room
from data_prep.front.houses import house_files, read_house
from data_prep.front.recipe import Recipe, load_recipe
from data_prep.readers.annotations import LIKE_NYU40, NYU40, Labels, read_labels
from data_prep.readers.frames import Y_UP
from data_prep.readers.scan_files import read_annotated_mesh
from sceneprior.core.classes import STUFF, label_set

sys.path.append(str(Path(__file__).parents[1] / "tests" / "data_prep" / "readers"))

from scan_files import TABLE, Box, ScanFolder, write_table

CATEGORIES = {
    "ceiling_lamp": "ceiling lamp", "children_cabinet": "cabinet", "coffee_table": "coffee table",
    "double_bed": "bed", "dressing_chair": "chair", "dressing_table": "dresser",
    "kids_bed": "bed", "pendant_lamp": "ceiling lamp", "single_bed": "bed", "sofa": "couch",
    "tv_stand": "tv stand", "void": "bench",
}  # fmt: skip
"""ScanNet's category of a class of 3D-FRONT, where it has another name. Categories without a NYU40
class are `otherfurniture`, which `prep-scannet` reads as void."""
EDGE_M = 0.06
"""Longest edge of the fused mesh."""
RANGE_M = 4.0
"""Range of the depth sensor."""
BEND_M, NOISE_M = 0.01, 0.005
"""Amplitude of the bend of the fused mesh, which varies over metres, and the noise of a vertex."""
BORDER_M, RAGGED = 0.03, 0.1
"""Vertices so near to another object belong to it with this probability."""
DRIFT = 0.5, 0.01
"""Error of a written pose in degrees and metres."""
LOST = 0.02
"""Share of the poses that are lost."""
MASK_SIZE = (484, 648)
"""(height, width) of the masks, half of ScanNet's."""


@dataclass
class MadeScan(ScanFolder):
    """A scan with the true `boxes` of its objects, and with its mesh in the scan's own frame."""

    vertices: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), dtype=int))
    owner: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=int))
    """Index into `boxes` of each vertex."""
    true_poses: list[np.ndarray] = field(default_factory=list)

    @property
    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices, faces, and the segment of each vertex; an object has two segments."""
        return self.vertices, self.faces, 10 * self.owner + 3 * (self.vertices[:, 0] > 0)

    def mask(self, frame: int, size: tuple[int, int] | None = None) -> np.ndarray:
        """objectId + 1 of the nearest triangle, which belongs to the object with most of its
        corners."""
        corners = self.owner[self.faces]
        most = np.where(corners[:, 1] == corners[:, 2], corners[:, 1], corners[:, 0])
        triangle, _ = self.nearest(self.true_poses[frame], size or self.size)
        return np.where(triangle < 0, 0, most[triangle] + 1).astype(np.uint8)

    def fuse(self, rng: np.random.Generator) -> None:
        """Keep the surface that the frames see, bend it, add noise, and make borders ragged."""
        seen = np.zeros(len(self.vertices), dtype=bool)
        for pose in self.true_poses:
            triangle, depth_m = self.nearest(pose, MASK_SIZE)
            seen[self.faces[np.unique(triangle[depth_m < RANGE_M])]] = True
        kept, number = np.unique(self.faces[seen[self.faces].all(axis=1)], return_inverse=True)
        self.faces, points = number.reshape(-1, 3), self.vertices[kept]
        bend = np.sin(points @ rng.normal(0, 2, (3, 3)) + rng.uniform(0, 2 * np.pi, 3))
        self.vertices = points + BEND_M * bend + rng.normal(0, NOISE_M, points.shape)
        self.owner = ragged(self.vertices, self.owner[kept], rng)


def ragged(points: np.ndarray, owner: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Give some of the vertices that are near to another object to that object."""
    _, near = cKDTree(points).query(points, 8, distance_upper_bound=BORDER_M)
    others = np.append(owner, -1)[near]  # the index of a missing neighbour is len(points)
    foreign = (others >= 0) & (others != owner[:, None])
    first = others[np.arange(len(points)), foreign.argmax(axis=1)]
    return np.where(foreign.any(axis=1) & (rng.random(len(points)) < RAGGED), first, owner)


def surfaces(room: Room) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """ScanNet's category, vertices and faces of the shell's parts and of the furniture, in the
    aligned frame: z up, edges of at most `EDGE_M`."""
    parts = [
        (name, room.shell[name].reshape(-1, 3), np.arange(3 * len(room.shell[name])).reshape(-1, 3))
        for name in STUFF[1:]
        if name in room.shell
    ]
    for piece in room.furniture:
        mesh = piece.mesh
        parts.append((CATEGORIES.get(piece.label, piece.label), mesh.vertices_m, mesh.faces))
    for name, vertices, faces in parts:
        points, triangles = trimesh.remesh.subdivide_to_size(vertices, faces, EDGE_M, max_iter=20)
        points, number = np.unique(points.round(4), axis=0, return_inverse=True)
        yield name, points @ Y_UP[:3, :3], number.reshape(-1)[triangles]


def scanned(room: Room, folder: Path, seed: int) -> MadeScan:
    """Scan one room, and write the scan."""
    rng = np.random.default_rng(seed)
    names, points, faces = zip(*surfaces(room), strict=True)
    boxes = [
        Box(name, each.min(axis=0), each.max(axis=0))
        for name, each in zip(names, points, strict=True)
    ]
    alignment = np.eye(4)
    alignment[:3, :3] = Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)]).as_matrix()
    alignment[:3, 3] = rng.uniform(-3, 3, 3)
    scan = MadeScan(folder, boxes, alignment)
    to_scan = np.linalg.inv(Y_UP @ alignment)
    scan.true_poses = [to_scan @ pose for pose in walk(room, rng)]
    vertices, scan.faces = trimesh.util.append_faces(points, faces)
    scan.vertices = (vertices - alignment[:3, 3]) @ alignment[:3, :3]
    scan.owner = np.repeat(np.arange(len(boxes)), [len(each) for each in points])
    scan.fuse(rng)
    scan.poses = swayed(scan.true_poses, *DRIFT, rng)
    for frame in np.flatnonzero(rng.random(len(scan.poses)) < LOST):
        scan.poses[frame] = np.full((4, 4), -np.inf)
    scan.write(MASK_SIZE)
    return scan


def overlaps(scan: MadeScan, labels: Labels) -> dict[str, list[float]]:
    """3D IoU of the boxes that `prep-scannet` reads with the true ones, by class; 0 for an object
    that no frame saw."""
    read = read_annotated_mesh(
        scan.path("_vh_clean_2.ply"),
        scan.path("_vh_clean_2.0.010000.segs.json"),
        scan.path(".aggregation.json"),
        scan.alignment,
    )
    found = {
        item.object_id: read.mesh.vertices_m[item.part] for item in read.objects if len(item.part)
    }
    scores: dict[str, list[float]] = defaultdict(list)
    for k, box in enumerate(scan.boxes):
        if labels.is_shell(box.category):
            continue
        lower, upper = box.corners.min(axis=0), box.corners.max(axis=0)
        points = found.get(k, np.zeros((1, 3)))
        low, high = points.min(axis=0), points.max(axis=0)
        shared = np.clip(np.minimum(upper, high) - np.maximum(lower, low), 0, None).prod()
        both = (upper - lower).prod() + (high - low).prod() - shared
        scores[labels.label(box.category)].append(float(shared / both))
    return scores


def write_labels(path: Path, recipe: Recipe) -> Labels:
    """Write the label table of the categories that scans of this recipe have."""
    raw = [*STUFF[1:], *(CATEGORIES.get(name, name) for name in label_set(recipe.label_set))]
    rows = [TABLE[0]]
    for number, name in enumerate(dict.fromkeys(raw), 1):
        nyu = LIKE_NYU40.get(name, name if name in NYU40 else "otherfurniture")
        rows.append((str(number), name, name, "1", str(NYU40.index(nyu) + 1), nyu))
    return read_labels(write_table(path, rows))


def rooms(homes: Path, recipe: Recipe) -> Iterator[tuple[Room, str]]:
    """Rooms of a folder of `make-homes`, each with its split."""
    bank = ModelBank(homes / "3D-FUTURE-model")
    splits = read_splits(homes / "splits" / f"{recipe.name}.csv")
    for path in house_files(homes / "3D-FRONT"):
        for room in read_house(path, bank, recipe).rooms:
            yield room, splits[room.room_id]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("homes", type=Path)
    parser.add_argument("out", type=Path, help="a new folder")
    parser.add_argument("--recipe", default="bedroom", help="bedroom or living")
    options = parser.parse_args()
    recipe, out = load_recipe(options.recipe), options.out
    out.mkdir(parents=True)
    labels = write_labels(out / "labels.tsv", recipe)
    lists: dict[str, list[str]] = {"train": [], "val": []}
    scores: dict[str, list[float]] = defaultdict(list)
    frames = 0
    for number, (room, split) in enumerate(rooms(options.homes, recipe)):
        scan = scanned(room, out / "scans" / f"scene{number:04d}_00", seed=number)
        lists["val" if split == "test" else "train"].append(scan.folder.name)
        frames += len(scan.poses)
        for name, each in overlaps(scan, labels).items():
            scores[name] += each
    for name, scan_ids in lists.items():
        (out / f"{name}.txt").write_text("".join(f"{scan_id}\n" for scan_id in scan_ids))
    print(f"{len(lists['train'])} training and {len(lists['val'])} test rooms, {frames} frames")
    print("| class | objects | box IoU | at least 0.5 |\n| --- | ---: | ---: | ---: |")
    scores["all"] = [iou for each in scores.values() for iou in each]
    for name, each in scores.items():
        share = np.mean(np.array(each) >= 0.5)
        print(f"| {name} | {len(each)} | {np.mean(each):.3f} | {share:.2f} |")


if __name__ == "__main__":
    main()
