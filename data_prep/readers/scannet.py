"""Reads ScanNet: a scan is a room, and the frames of its recording are its views.

<scan>.sens, <scan>.txt                             recording and alignment with the walls
<scan>_vh_clean_2.ply, ..._2.0.010000.segs.json     mesh, and the segment of each vertex
<scan>.aggregation.json                             objects, which are sets of segments
<scan>_2d-instance-filt.zip or <scan>_2d-instance.zip     masks of the objects
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from data_prep.engine.plan import digest, seeded_split
from data_prep.engine.source import Line, RoomTask
from data_prep.readers.annotations import LABEL_SET, Labels, download, read_labels
from data_prep.readers.frames import (
    Y_UP,
    choose_frames,
    is_pose,
    mask_intrinsics,
    pose_fault,
    sampled_lines,
)
from data_prep.readers.reader import FoundRoom, Reader
from data_prep.readers.rooms import FramedRoom, ScannedObjects
from data_prep.readers.scan_files import (
    ScanObject,
    open_masks,
    read_annotated_mesh,
    read_sens,
)
from sceneprior.core.checked import plain, shown
from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_folders, read_text
from sceneprior.core.observations import thinned_stuff

MASK_FILES = {"filt": "_2d-instance-filt.zip", "raw": "_2d-instance.zip"}
"""Suffix of the archive's name, after the scan's, for each value of `--masks`."""
_ALIGNMENT = re.compile(r"\s*axisAlignment\s*=")
FULL_SIZE = (968, 1296)
QUARTER_SIZE = (242, 324)
"""(height, width) of ScanNet's colour frames, and a quarter of it, the paper's rendering size."""
_OFFICIAL = {"rooms": 1513, "train": 1201, "test": 312, "views": 108_059}


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

    @property
    def official(self) -> tuple[str, dict[str, int]] | None:
        """See `Source.official`: those of the lists, if both are given and all scans are asked."""
        of = "ScanNet v2 by its lists; views as the paper counts them (section 5)"
        return (of, _OFFICIAL) if self.train and self.val and self.only is None else None

    def options(self) -> dict[str, Any]:
        names = ("frame_step", "max_views", "masks", "image_size")
        return {name: getattr(self, name) for name in names}

    def fingerprint(self, scenes: list[str]) -> dict[str, Any]:
        read_labels(self.labels)
        if self.train or self.val:
            split_scans(self.scenes(), self.train, self.val)
        texts = {"labels": self.labels, "train": self.train, "val": self.val}
        digests = {name: path and digest(read_text(path)) for name, path in texts.items()}
        return {"scans": digest("\n".join(scenes)), **digests}

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
        world_from_scan = Y_UP if alignment is None else Y_UP @ alignment
        scan = read_annotated_mesh(
            folder / f"{name}_vh_clean_2.ply",
            folder / f"{name}_vh_clean_2.0.010000.segs.json",
            folder / f"{name}.aggregation.json",
            world_from_scan,
        )
        notes = [*scan.notes]
        if alignment is None:
            notes.append(
                f"{name}.txt has no axisAlignment, which ScanNet v2's file has: the "
                "direction of the walls is found from masks"
            )
        labels = read_labels(self.labels)
        objects = []
        for item in scan.objects:
            if labels.nyu40_class(item.category) is None:
                what = f"{shown(item.category)} is not in {labels.source}, so void"
                notes.append(f"object {item.object_id}: {what}")
            if len(item.part):
                objects.append(item)
            else:
                what = f"({plain(item.category)}) has no vertices; left out"
                notes.append(f"object {item.object_id} {what}")
        poses, intrinsics, ids, stuff = self._views(folder, objects, labels, notes)
        classes = label_set(LABEL_SET)
        kinds = [classes.index(labels.label(item.category)) for item in objects]
        return FramedRoom(
            where=task.room_id,
            ids=ids,
            object_class=np.array([*kinds, VOID], dtype=np.int16),
            camera_to_world=world_from_scan @ poses.astype(np.float64),
            intrinsics=intrinsics,
            stuff=stuff,
            notes=tuple(notes),
            is_aligned=alignment is not None,
            world_from_file=world_from_scan,
            boxes={k: scan.mesh.vertices_m[item.part] for k, item in enumerate(objects)},
            scan=ScannedObjects(
                scan.mesh,
                [item.part for item in objects],
                [f"{task.room_id}_{item.object_id:03d}" for item in objects],
            ),
            floor_of_unseen=True,
            ceiling_y=float(scan.mesh.vertices_m[:, 1].max()),
            why_below=None,
        )

    def _views(
        self, folder: Path, objects: list[ScanObject], labels: Labels, notes: list[str]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Poses, intrinsics (3, 3), images of ids and of stuff, of the frames that become views.

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
            for number in (item.object_id, *item.others):
                if number < 255:  # an 8-bit mask cannot show more
                    known.append(number + 1)
                    table[known[-1]] = 0 if labels.is_shell(item.category) else k
                    stuff_table[known[-1]] = labels.stuff(item.category)
        mask_path, sens_path = self._mask_path(folder), folder / f"{folder.name}.sens"
        sens = read_sens(sens_path)
        images, stuff, unlisted = [], [], set[int]()
        with open_masks(mask_path) as masks:
            frames, rejected = choose_frames(
                str(sens_path), sens.camera_to_world, masks.frames, self.max_views,
                self.frame_step, "mask", f" in {mask_path.name}",
                hint=" Download the scan again, or leave it out.",
            )  # fmt: skip
            notes += rejected
            try:
                intrinsics = mask_intrinsics(
                    sens.intrinsics, sens.color_size, masks.image_size, self.image_size
                )
            except InputError as error:
                raise InputError(f"{mask_path}: {error}") from None
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
        return sens.camera_to_world[frames], intrinsics, np.stack(images), np.stack(stuff)

    def _mask_path(self, scan: Path) -> Path:
        paths = {name: scan / f"{scan.name}{ending}" for name, ending in MASK_FILES.items()}
        if paths[self.masks].is_file():
            return paths[self.masks]
        others = [
            f" (or give --masks {name}, whose archive is here)"
            for name, path in paths.items()
            if path.is_file()
        ]
        raise InputError(
            f"{paths[self.masks]} is missing: the instance masks. Download it into the scan's "
            f"folder{''.join(others)}."
        )


def read_alignment(path: Path) -> np.ndarray | None:
    """Read the rigid transform, (4, 4), that aligns a scan's walls with the axes; z is up.

    It is among the `key = value` lines of `<scan>.txt`; None if the file has none, as for scans of
    version 1 and test scans.
    """
    lines = read_text(path, hint=download(path)).splitlines()
    values = [line.partition("=")[2].split() for line in lines if _ALIGNMENT.match(line)]
    if not values:
        return None
    words = values[-1]
    try:
        matrix = np.array([float(word) for word in words]).reshape(4, 4)
    except ValueError:
        raise InputError(
            f"{path}: axisAlignment is {len(words)} words, expected 16 numbers. "
            "Download the scan again."
        ) from None
    if not is_pose(matrix[None])[0]:
        raise InputError(
            f"{path}: axisAlignment is not a rotation with a translation: {pose_fault(matrix)}; "
            "the file is damaged, or an axis was flipped. Download the scan again."
        )
    return matrix


def find_scans(folder: Path) -> list[Path]:
    """Find the scan folders in ScanNet's `scans`, sorted.

    A scan folder is named like `scene0000_00` or holds a `.sens` with the folder's name.
    """
    if not folder.is_dir():
        raise InputError(f"No folder at {folder}; --scans names ScanNet's folder of scans.")
    found = list(filter(_is_scan, list_folders(folder)))
    if not found:
        inside, whole = folder / "scans", folder.absolute()
        meant = inside if inside.is_dir() else whole.parent if _is_scan(whole) else None
        hint = "." if meant is None else f"; did you mean {meant}?"
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
        if path is None:
            continue
        lines = read_text(path, hint="give a list of scans").splitlines()
        for number, line in enumerate(map(str.strip, lines), 1):
            if re.search(r"[\s,;]", line):
                raise InputError(
                    f"{path}, line {number}: '{line[:60]}' is not a scan id; expected one "
                    "(scene0000_00) a line, as in scannetv2_train.txt."
                )
            if line and listed.setdefault(line, split) != split:
                raise InputError(f"{line} is in both {train} and {val}; a scan has one split.")
    split_of = {name: listed[name] for name in scan_ids if name in listed}
    if not split_of:
        lists = " and ".join(str(path) for path in (train, val) if path is not None)
        raise InputError(
            f"None of the {len(scan_ids)} scans is in {lists or 'a list, as no list is given'}; "
            "check that --train-list and --val-list are ScanNet's scannetv2_train.txt and "
            "scannetv2_val.txt."
        )
    return split_of, [name for name in listed if name not in split_of]
