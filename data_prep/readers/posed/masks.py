"""The masks of a room, in any tool's format: the interface of formats, and how they are read."""

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from data_prep.readers.frames import mask_intrinsics, sampled, turned_hint
from data_prep.readers.posed.cameras import Lens, Straightened, straighten
from data_prep.readers.posed.recording import INSTANCES, PosedFrame, as_png, frame_intrinsics
from data_prep.tracks.associate import UNKNOWN, FrameMasks, associate
from sceneprior.core.checked import plain, shown
from sceneprior.core.classes import VOID, label_set
from sceneprior.core.coco import check_size, decode, paint
from sceneprior.core.errors import InputError
from sceneprior.core.id_tables import LARGEST_ID, IdTable, read_mask, tidy
from sceneprior.core.observations import thinned_stuff

PANOPTIC = "panoptic.json"
TABLES = ("classes.json", "classes.csv", PANOPTIC)
_LISTED = 3
_MANY_IDS, _MANY_FRAMES, _ONCE = 12, 5, 0.8
"""A room with at least these numbers of ids and frames is refused if more than this share of the
ids occurs in a single frame only."""


@dataclass(frozen=True)
class FrameMask:
    """The masks of one frame, still in their files."""

    size: Callable[[], tuple[int, int]]
    """(height, width)."""
    read: Callable[[], np.ndarray]
    """Ids, (height, width) integers, 0 for background."""
    classes: Callable[[], dict[int, str]]
    """Class of each id, if ids belong to single frames."""


@dataclass
class SegmentedFrame:
    """Masks of one frame as polygons or run lengths, which are decoded when the frame is read.
    They may overlap (`paint`)."""

    size: tuple[int, int]
    where: str
    """File and frame, for messages."""
    masks: list[tuple[int, Any, str]] = field(default_factory=list)
    """Id, segmentation and place of each mask."""
    classes: dict[int, str] = field(default_factory=dict)

    def add(self, number: int, name: str, segmentation: Any, where: str) -> None:
        """Add a mask; `where` names it within the frame."""
        self.masks.append((number, segmentation, f"{self.where}, {where}"))
        self.classes[number] = name

    def read(self) -> np.ndarray:
        """Ids, (height, width)."""
        masks = ((k, decode(mask, self.size, where)) for k, mask, where in self.masks)
        return paint(masks, self.size)

    def put(self, frames: dict[str, FrameMask], file_name: str) -> None:
        """Add the frame to others by the stem of its picture's name, which must be unique."""
        check_size(self.size, self.where)
        if (stem := Path(as_png(file_name)).stem) in frames:
            raise InputError(
                f"{self.where}: two pictures are named {shown(stem)}; a room has one of each name."
            )
        frames[stem] = FrameMask(lambda: self.size, self.read, lambda: self.classes)


class MaskFormat(ABC):
    """The masks of one room in one tool's format.

    `folder` is the room's folder. `label_set_name` decides whether walls and floors are objects, in
    formats that distinguish them from objects.
    """

    name: ClassVar[str]
    """Value of `--from`."""
    title: ClassVar[str]
    """Name of the tool, and files or folders of the masks, for messages."""

    def __init__(self, folder: Path, label_set_name: str):
        self.folder, self.label_set_name = folder, label_set_name
        self.class_map: Mapping[str, str] = {}
        """Classes of names of the masks, by the names as `tidy`."""
        self.notes: list[str] = []

    @property
    def tracked(self) -> bool:
        """False if the ids belong to single images, whatever the option `--tracks` says."""
        return True

    @classmethod
    @abstractmethod
    def find(cls, folder: Path) -> list[Path]:
        """All mask files of a room; empty if the room has no masks in this format."""

    @property
    def frames(self) -> Mapping[str, FrameMask]:
        """Masks by the stem of the frame's picture, for formats that find masks by it."""
        raise NotImplementedError

    def of(self, frame: PosedFrame) -> FrameMask | None:
        """The masks of a frame, even if they show no object; None if it has none."""
        return self.frames.get(frame.stem)

    def table(self, of_id: dict[int, str]) -> IdTable:
        """The table of ids whose names are given, mapped to classes."""
        return IdTable(
            {key: self.mapped(name) for key, name in of_id.items()},
            self.label_set_name,
            str(self.folder),
        )

    def mapped(self, name: str) -> str:
        """The class of a name of the masks."""
        return self.class_map.get(tidy(name), name)

    def wanted(self, frame: PosedFrame) -> str:
        """Description, for messages, of the expected file of a frame's masks, and of what exists
        instead."""
        return f"a picture {shown(frame.stem)} in {self.find(self.folder)[0]}{instead(self.frames)}"

    def unused(self, frames: Sequence[PosedFrame]) -> tuple[str, ...]:
        """A note on masks of none of the frames; empty without such."""
        return _without_frame(self.frames, {frame.stem for frame in frames})

    def classes(self) -> dict[int, str]:
        """Class of each id, if ids are the same in all frames."""
        return self.main_classes(frame.classes() for frame in self.frames.values())

    def main_classes(self, of_frames: Iterable[dict[int, str]]) -> dict[int, str]:
        """The most frequent class of each id over all frames, one of the label set if several are,
        under one of its names; `notes` has one on ids with several classes."""
        votes: dict[int, Counter[str]] = {}
        names: dict[str, str] = {}
        for classes in of_frames:
            for number, name in classes.items():
                names.setdefault(self.mapped(name), name)
                votes.setdefault(number, Counter())[self.mapped(name)] += 1
        changing = [
            f"{number} ({', '.join(f'{plain(name)} {k}' for name, k in count.most_common())})"
            for number, count in sorted(votes.items())
            if len(count) > 1
        ]
        note = f"ids with several classes take the most frequent one: {_some(changing)}"
        self.notes = [note] if changing else []
        own = {tidy(name) for name in label_set(self.label_set_name)}
        return {
            number: names[max(count, key=lambda name: (count[name], tidy(name) in own))]
            for number, count in sorted(votes.items())
        }


class FramePngs(MaskFormat):
    """One PNG per frame: `PosedFrame.instances`."""

    def wanted(self, frame: PosedFrame) -> str:
        return f"{frame.instances}{instead(self._pngs)}"

    @cached_property
    def _pngs(self) -> dict[str, Path]:
        """PNGs by their names within the folder of PNGs."""
        found, place = self.find(self.folder), self.folder / INSTANCES
        pngs = [path for path in found if path.suffix == ".png" and place in path.parents]
        return {path.relative_to(place).as_posix(): path.resolve() for path in pngs}

    def unused(self, frames: Sequence[PosedFrame]) -> tuple[str, ...]:
        used = {path.resolve() for f in frames for path in (f.instances, f.known) if path}
        return _without_frame(self._pngs, {k for k, path in self._pngs.items() if path in used})

    def of(self, frame: PosedFrame) -> FrameMask | None:
        path = frame.instances
        return self.of_png(path) if path.is_file() else None

    @abstractmethod
    def of_png(self, path: Path) -> FrameMask:
        """The masks in a PNG."""


def find_table(folder: Path) -> Path:
    """Find the only table in a folder that maps the room's ids to classes: one of `TABLES`."""
    found = [folder / name for name in TABLES if (folder / name).is_file()]
    if len(found) != 1:
        named = " and ".join(path.name for path in found) or f"no {' or '.join(TABLES)}"
        raise InputError(f"{folder} has {named}; expected one table with the class of each id.")
    return found[0]


def instead(names: Iterable[str]) -> str:
    """Describe the names that exist where another name was expected, if there are any."""
    listed = [plain(name) for name in sorted(names)]
    return f", but there is {_some(listed)}: give masks the names of their frames" if listed else ""


def _without_frame(masks: Collection[str], used: Collection[str]) -> tuple[str, ...]:
    if not (left := sorted(set(masks) - set(used))):
        return ()
    names = _some([plain(name) for name in left])
    return (f"{len(left)} of {len(masks)} masks have no frame ('{names}'); unused",)


def _some(words: list[str]) -> str:
    return ", ".join(words[:_LISTED]) + (", ..." if len(words) > _LISTED else "")


def read_tracked(
    masks: MaskFormat, frames: list[PosedFrame], size: tuple[int, int], max_side: int | None
) -> dict[str, Any]:
    """Read masks whose ids are the same in all frames, as fields of a `FramedRoom`; see `_pixels`.

    An `InputError` if most ids occur in one frame only, as if each frame had its own ids.
    """
    table = masks.table(masks.classes())
    of_lenses: list[str] = []
    images, stuff, intrinsics = [], [], []
    frames_of = np.zeros(len(table.classes) + 1, dtype=np.int64)
    for values, K in _pixels(masks, frames, size, max_side, of_lenses):
        images.append(table.ids(values))
        frames_of[np.unique(images[-1])] += 1
        stuff.append(thinned_stuff(table.stuff(values)))
        intrinsics.append(K)
    notes = [*masks.notes, *table.notes]
    if table.unlisted:
        listed = ", ".join(map(str, sorted(table.unlisted)[:20]))
        notes.append(f"masks show ids that the table of classes does not have ({listed}): void")
    frames_of = frames_of[1:-1]  # without the background and without masks of no class
    if hidden := [str(table.objects[k]) for k in np.flatnonzero(frames_of == 0)]:
        notes.append(f"{len(hidden)} of {len(frames_of)} ids show in no view ({_some(hidden)})")
    count, once = int((frames_of > 0).sum()), int((frames_of == 1).sum())
    if len(images) >= _MANY_FRAMES and count >= _MANY_IDS and once > _ONCE * count:
        raise InputError(
            f"{once} of its {count} ids are in one of {len(images)} frames only, expected the same "
            "id for an object in all frames; --tracks auto finds the objects of such masks."
        )
    return {
        "ids": np.stack(images),
        "object_class": table.classes,
        "outside": table.outside,
        "stuff": np.stack(stuff),
        "intrinsics": np.stack(intrinsics),
        "notes": (*notes, *of_lenses),
    }


def read_untracked(
    masks: MaskFormat,
    frames: list[PosedFrame],
    size: tuple[int, int],
    max_side: int | None,
    world_to_camera: np.ndarray,
) -> dict[str, Any]:
    """Read masks whose ids and classes belong to single frames, and find the objects they show."""
    of_lenses: list[str] = []
    pixels = zip(*_pixels(masks, frames, size, max_side, of_lenses), strict=True)
    images, intrinsics = (np.stack(arrays) for arrays in pixels)
    # Masks of all frames are numbered through.
    numbers = np.where(images < 0, -1, 0)
    class_names: dict[int, str] = {}
    original_ids, unlisted = [0], 0
    for image, number, frame in zip(images, numbers, frames, strict=True):
        mask = masks.of(frame)
        names = mask.classes() if mask is not None else {}
        for k in np.unique(image[image > 0]).tolist():
            if k not in names:
                number[image == k] = -1
                unlisted += 1
                continue
            class_names[len(original_ids)] = names[k]
            number[image == k] = len(original_ids)
            original_ids.append(k)
    if (count := len(original_ids)) > LARGEST_ID:
        raise InputError(
            f"{masks.folder} has {count - 1} masks, expected at most {LARGEST_ID - 1}; use fewer "
            "frames (--max-views)."
        )
    table = masks.table(class_names)
    ids = table.ids(numbers).astype(np.int32)
    # The table's last id stands for masks without a class, whose content is unknown.
    ids[ids == len(table.classes)] = UNKNOWN
    given = np.array(original_ids)[table.objects]
    notes = [*table.notes, *of_lenses]
    if unlisted:
        notes.append(f"{unlisted} masks have no class in their frame's table: void")
    frame_masks = FrameMasks(ids, table.classes[:-1].astype(np.int64))
    tracks = associate(frame_masks, world_to_camera, intrinsics, given)
    count = len(tracks.object_class)
    # Objects, as classes are counted: an object has this many masks on average.
    masks_each = max(len(given) / max(count, 1), 1.0)
    outside = {name: math.ceil(k / masks_each) for name, k in table.outside.items()}
    notes.append(f"{count} objects are found from {len(given)} masks (--tracks auto)")
    return {
        "ids": np.where(tracks.ids < 0, count + 1, tracks.ids).astype(np.uint32),
        "object_class": np.array([*tracks.object_class, VOID]),
        "outside": outside,
        "stuff": thinned_stuff(table.stuff(numbers)),
        "intrinsics": intrinsics,
        "notes": tuple(notes),
    }


def _pixels(
    masks: MaskFormat,
    frames: list[PosedFrame],
    size: tuple[int, int],
    max_side: int | None,
    notes: list[str],
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Values of each frame's masks, int32 with -1 where unknown, and their intrinsics, undistorted
    and downsampled to `max_side`. `size` is the (height, width) of all masks; `notes` takes
    sentences on the lenses."""
    views: dict[tuple[Lens, bytes], Straightened] = {}
    for frame in frames:
        mask = masks.of(frame)
        if mask is None:
            raise InputError(f"{masks.wanted(frame)} is missing")
        values = mask.read().astype(np.int32)
        if values.shape != size:
            raise InputError(
                f"the mask of frame {shown(frame.name)} is {values.shape[1]} x {values.shape[0]} "
                f"pixels, but the first frame's {size[1]} x {size[0]}; a room has one size."
                + turned_hint(values.shape, size)
            )
        if frame.known is not None:
            known = read_mask(frame.known)
            if known.shape != size:
                raise InputError(
                    f"{frame.known} is {known.shape[1]} x {known.shape[0]} pixels, but the ids "
                    f"{size[1]} x {size[0]}"
                )
            values[known == 0] = -1
        K, picture = frame_intrinsics(frame, size)
        K = mask_intrinsics(K, picture, size, size)
        if not (lens := frame.camera.lens).is_straight:
            key = lens, K.tobytes()
            try:
                view = views[key] if key in views else straighten(lens, K, size)
            except InputError as error:
                raise InputError(f"frame {shown(frame.name)}: {error}") from None
            views[key] = view
            K, values = view.intrinsics, values[view.rows, view.columns]
        lines, K = sampled(size, max_side, K)
        yield values[lines], K
    for lens in dict.fromkeys(lens for lens, _ in views):
        cut = max(view.cut_share for (other, _), view in views.items() if other == lens)
        notes.append(f"the lens {lens} is undistorted; {cut:.0%} of its pictures is cut away")
