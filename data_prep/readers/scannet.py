"""Reads ScanNet: a scan is a room, and the frames of its recording are its views.

<scan>.sens, <scan>.txt                             recording and alignment with the walls
<scan>_vh_clean_2.ply, ..._2.0.010000.segs.json     mesh, and the segment of each vertex
<scan>.aggregation.json                             objects, which are sets of segments
<scan>_2d-instance-filt.zip or <scan>_2d-instance.zip     masks of the objects
"""

import contextlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from data_prep.engine.plan import digest, seeded_split
from data_prep.engine.source import Line, RoomTask
from data_prep.readers.annotations import LABEL_SET, Labels, read_labels
from data_prep.readers.frames import Y_UP, chosen_frames, mask_intrinsics, sampled_lines
from data_prep.readers.reader import FoundRoom, Reader
from data_prep.readers.rooms import FramedRoom, ScannedObjects
from data_prep.readers.scan_files import MASK_FILES, MaskArchive, read_alignment, read_sens
from data_prep.readers.scanned_mesh import AnnotatedMesh, read_annotated_mesh
from sceneprior.core.checked import plain, shown
from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.observations import thinned_stuff

FULL_SIZE = (968, 1296)
QUARTER_SIZE = (242, 324)
"""(height, width) of ScanNet's colour frames, and a quarter of it, the paper's rendering size."""


@dataclass(frozen=True, kw_only=True)
class ScanNet(Reader):
    """ScanNet's scans; each scan of a space is a separate room."""

    name: ClassVar = "scannet"
    scene_word: ClassVar = ("scan", "a scan, such as scene0000_00")
    surveys_all: ClassVar = True
    labels: Path
    """scannetv2-labels.combined.tsv."""
    frame_step: int = 15
    """Step between candidate frames; ScanNet's common export takes every 15th."""
    masks: str = "filt"
    """`filt`: cleaned by ScanNet along depth and colour edges; `raw`: the projected mesh."""
    image_size: tuple[int, int] = QUARTER_SIZE
    """(height, width) of stored images. It is the same for all rooms, even those recorded at
    640 x 480, because batches mix rooms. `FULL_SIZE` keeps every pixel."""
    train: Path | None = None
    val: Path | None = None
    """The official lists; `val` becomes the split `test`. None splits the spaces 9:1 by the
    seed."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._check_positive("frame_step")
        if self.masks not in MASK_FILES:
            raise InputError(f"masks is '{self.masks}'; choose {' or '.join(MASK_FILES)}.")

    def options(self) -> dict[str, Any]:
        names = ("frame_step", "max_views", "masks", "image_size")
        return {name: getattr(self, name) for name in names}

    def fingerprint(self, scenes: list[str]) -> dict[str, Any]:
        read_labels(self.labels)
        if self.train or self.val:
            split_scans(self.scenes(), self.train, self.val)
        texts = {"labels": self.labels, "train": self.train, "val": self.val}
        return {
            "scans": digest("\n".join(scenes)),
            **{
                name: None if path is None else digest(path.read_text(encoding="utf-8"))
                for name, path in texts.items()
            },
        }

    def scenes(self) -> list[str]:
        """See `Reader.scenes`; a scan without its `.sens` is listed, so that the report has it."""
        return [path.name for path in find_scans(self.folder)]

    def rooms(self, scene: str) -> dict[str, FoundRoom]:
        """The scan as one room, without opening it."""
        return {scene: FoundRoom(self.image_size)}

    def split_rooms(self, rooms: Mapping[str, str]) -> tuple[dict[str, str], list[Line]]:
        """See `Reader.split_rooms`: by the lists, or by space, as rescans show the same room."""
        if not (self.train or self.val):
            half = seeded_split(list(dict.fromkeys(map(space_of, rooms))), self.seed)
            return {name: half[space_of(name)] for name in rooms}, []
        split_of, missing = split_scans([*rooms], self.train, self.val)
        others = [name for name in rooms if name not in split_of]
        why = f"a list names it, but {self.folder} has no such folder"
        return split_of, [
            *(Line(name, name, "filtered", "split", "it is in no list") for name in others),
            *(Line(name, name, "filtered", "split", why) for name in missing),
        ]

    @property
    def split_hint(self) -> str:
        return "the lists" if self.train or self.val else ""

    def read(self, task: RoomTask) -> FramedRoom:
        """Read a scan.

        The walls' direction is that of axisAlignment, with (x, y, z) mapped to (y, z, x) so that y
        is up, or is found from the masks. The floor is at the lowest point of the boxes of objects
        with a class, because ScanNet has no floor plans, and its annotated floors cover only the
        parts that the camera saw.
        """
        folder, name = self.folder / task.house, task.house
        alignment = read_alignment(folder / f"{name}.txt")
        is_aligned = alignment is not None
        world_from_scan = Y_UP if alignment is None else Y_UP @ alignment
        scan = read_annotated_mesh(
            folder / f"{name}_vh_clean_2.ply",
            folder / f"{name}_vh_clean_2.0.010000.segs.json",
            folder / f"{name}.aggregation.json",
            world_from_scan,
        )
        notes = [*scan.notes]
        if not is_aligned:
            notes.append(
                f"{name}.txt has no axisAlignment, which ScanNet v2's file has: the "
                "direction of the walls is found from masks"
            )
        labels = read_labels(self.labels)
        objects = _objects(scan, labels, notes)
        poses, intrinsics, ids, stuff = self._views(folder, objects, notes)
        classes = label_set(LABEL_SET)
        kinds = [classes.index(item.label) for item in objects]
        return FramedRoom(
            where=task.room_id,
            ids=ids,
            object_class=np.array([*kinds, VOID], dtype=np.int16),
            camera_to_world=world_from_scan @ poses.astype(np.float64),
            intrinsics=intrinsics,
            stuff=stuff,
            notes=tuple(notes),
            is_aligned=is_aligned,
            world_from_file=world_from_scan,
            boxes={k: scan.points_m(item.row) for k, item in enumerate(objects)},
            scan=ScannedObjects(
                scan.mesh,
                [scan.parts[item.row] for item in objects],
                [f"{task.room_id}_{item.object_id:03d}" for item in objects],
            ),
            floor_of_unseen=True,
            ceiling_y=float(scan.mesh.vertices_m[:, 1].max()),
            why_below=None,
        )

    def _views(
        self, folder: Path, objects: list["_Object"], notes: list[str]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Poses, intrinsics (3, 3), images of ids and of stuff, of the frames that become views."""
        mask_path, sens_path = _mask_path(folder, self.masks), folder / f"{folder.name}.sens"
        sens = read_sens(sens_path)
        with contextlib.closing(MaskArchive(mask_path)) as masks:
            choice = chosen_frames(
                str(sens_path), sens.camera_to_world, masks.frames, self.max_views,
                self.frame_step, f"mask in {mask_path.name}",
                hint=" Download the scan again, or leave it out.",
            )  # fmt: skip
            notes += choice.notes("mask")
            try:
                intrinsics = mask_intrinsics(
                    sens.intrinsics, sens.color_size, masks.image_size, self.image_size
                )
            except InputError as error:
                raise InputError(f"{mask_path}: {error}") from None
            ids, stuff = self._images(masks, choice.frames, objects, notes)
        return sens.camera_to_world[list(choice.frames)], intrinsics, ids, stuff

    def _images(
        self, masks: MaskArchive, frames: Sequence[int], objects: list["_Object"], notes: list[str]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Images of ids and of stuff (`FramedRoom`).

        An image of ids shows that two objects touch, but not which one is in front. So a side is
        clear if no other furniture, void included, touches it. The room's shell (walls, floor,
        doors, ...) is background, because it is nearly always behind; a wall corner or an open door
        that does occlude a side goes unnoticed. The ground truth's `unoccluded` accounts for these,
        but only `inspect --verify` uses it.
        """
        unknown = len(objects) + 1
        table = np.full(256, unknown, dtype=np.uint8 if unknown <= 255 else np.uint16)
        stuff_table = np.zeros(256, dtype=np.uint8)
        table[0] = 0
        known = [0]
        for k, item in enumerate(objects, start=1):
            if item.object_id < 255:  # an 8-bit mask cannot show more
                known.append(item.object_id + 1)
                table[known[-1]] = 0 if item.is_shell else k
                stuff_table[known[-1]] = item.stuff
        images, stuff, unlisted = [], [], set()
        sizes = zip(masks.image_size, self.image_size, strict=True)
        lines = np.ix_(*(sampled_lines(*size) for size in sizes))
        for frame in frames:
            values = masks.read(frame)[lines]
            images.append(table[values])
            stuff.append(stuff_table[thinned_stuff(values)])
            unlisted.update(np.setdiff1d(values, known).tolist())
        if unlisted:
            listed = ", ".join(str(value - 1) for value in sorted(unlisted))
            notes.append(f"masks show objects that the aggregation does not have ({listed}): void")
        return np.stack(images), np.stack(stuff)


def _mask_path(scan: Path, kind: str) -> Path:
    paths = {name: scan / f"{scan.name}{ending}" for name, ending in MASK_FILES.items()}
    if paths[kind].is_file():
        return paths[kind]
    others = [
        f" (or give --masks {name}, whose archive is here)"
        for name, path in paths.items()
        if path.is_file()
    ]
    raise InputError(
        f"{paths[kind]} is missing: the instance masks. Download it into the scan's folder"
        f"{''.join(others)}."
    )


class _Object(NamedTuple):
    """One annotated object with vertices."""

    row: int
    """Index into the groups of the mesh."""
    object_id: int
    """Id of the object; its value in the masks is one more."""
    label: str
    """Class of the label set `scannet`; `void` outside its 19 classes."""
    is_shell: bool
    """True for a part of the room (wall, floor, ...), false for furniture."""
    stuff: int
    """Index into `STUFF`."""


def _objects(scan: AnnotatedMesh, labels: Labels, notes: list[str]) -> list[_Object]:
    """Objects of a scan in the order of their ids, without those that have no vertices."""
    objects = []
    for row, group in enumerate(scan.groups):
        if labels.nyu40_class(group.category) is None:
            notes.append(
                f"object {group.object_id}: {shown(group.category)} is not in {labels.source}, so "
                "void"
            )
        if not len(scan.parts[row]):
            notes.append(
                f"object {group.object_id} ({plain(group.category)}) has no vertices; left out"
            )
            continue
        kind, stuff = labels.label(group.category), labels.stuff(group.category)
        is_shell = labels.is_shell(group.category)
        objects.append(_Object(row, group.object_id, kind, is_shell, stuff))
    return objects


def find_scans(folder: Path) -> list[Path]:
    """Find the scan folders in ScanNet's `scans`, sorted.

    A scan folder is named like `scene0000_00` or holds a `.sens` with the folder's name.
    """
    if not folder.is_dir():
        raise InputError(f"No folder at {folder}; --scans names ScanNet's folder of scans.")
    found = [path for path in sorted(folder.iterdir()) if path.is_dir() and _is_scan(path)]
    if not found:
        inside = folder / "scans"
        hint = (
            f"; did you mean {inside}?"
            if inside.is_dir()
            else f"; did you mean {folder.absolute().parent}?"
            if _is_scan(folder.absolute())
            else "."
        )
        raise InputError(f"{folder} holds no scans (scene0000_00/ and so on){hint}")
    return found


def _is_scan(path: Path) -> bool:
    named = re.fullmatch(r"scene\d{4}_\d{2}", path.name)
    return bool(named) or (path / f"{path.name}.sens").is_file()


def space_of(scan_id: str) -> str:
    """Space in which a scan was made: `scene0000` for `scene0000_01`."""
    return re.sub(r"_\d{2}$", "", scan_id)


def split_scans(
    scan_ids: Sequence[str], train: Path | None, val: Path | None
) -> tuple[dict[str, str], list[str]]:
    """Split scans by the official lists, one scan id per line; `val` becomes the split `test`.

    Returns the split of each listed scan, in the order of `scan_ids`, and the listed scans that
    are not among these.
    """
    listed: dict[str, str] = {}
    for path, split in ((train, "train"), (val, "test")):
        for scan_id in [] if path is None else _read_list(path):
            if listed.setdefault(scan_id, split) != split:
                raise InputError(f"{scan_id} is in both {train} and {val}; a scan has one split.")
    split_of = {name: listed[name] for name in scan_ids if name in listed}
    if not split_of:
        lists = " and ".join(str(path) for path in (train, val) if path is not None)
        raise InputError(
            f"None of the {len(scan_ids)} scans is in {lists or 'a list, as no list is given'}; "
            "check that --train-list and --val-list are ScanNet's scannetv2_train.txt and "
            "scannetv2_val.txt."
        )
    return split_of, [name for name in listed if name not in split_of]


def _read_list(path: Path) -> list[str]:
    try:
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"The list of scans {path} cannot be read ({error}).") from None
    for number, line in enumerate(lines, 1):
        if re.search(r"[\s,;]", line):
            raise InputError(
                f"{path}, line {number}: '{line[:60]}' is not a scan id; expected one "
                "(scene0000_00) a line, as in scannetv2_train.txt."
            )
    return [line for line in lines if line]
