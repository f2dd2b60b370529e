"""Source for ScanNet: a scan is a room, and the frames of its recording are its views."""

import functools
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from data_prep.engine.plan import digest, house_may_match, seeded_split, select
from data_prep.engine.source import Line, PreparedRoom, RoomTask, Survey
from data_prep.engine.workers import Run
from data_prep.readers.heading import find_turn, note_of_turn
from data_prep.readers.scannet.labels import LABEL_SET, Labels, read_labels
from data_prep.readers.scannet.scans import Scan, ScanSettings, read_scan
from data_prep.readers.scannet.splits import find_scans, space_of, split_scans
from data_prep.readers.scannet.views import prepare_scan
from sceneprior.core.errors import InputError
from sceneprior.render.offscreen import Renderer


@dataclass(frozen=True)
class ScanNetSource:
    """The `Source` (data_prep/engine/source.py) behind `prep-scannet`."""

    name: ClassVar = "scannet"
    label_set: ClassVar = LABEL_SET
    room_type: ClassVar = "scannet"
    draws: ClassVar = False
    scans: Path
    labels: Path
    """scannetv2-labels.combined.tsv."""
    scan_settings: ScanSettings = field(default_factory=ScanSettings)
    train: Path | None = None
    val: Path | None = None
    """The official lists, of 1,201 and 312 scans; `val` becomes the split `test`. None splits the
    spaces 9:1 by the seed."""
    seed: int = 0
    only: str | None = None

    def settings(self, only: str | None) -> dict[str, Any]:
        """See `Source.settings`."""
        read_labels(self.labels)
        folders = self._folders(only)
        lists = {"train": self.train, "val": self.val}
        if self.train or self.val:
            split_scans(find_scans(self.scans), self.train, self.val)
        return {
            "recipe": asdict(self.scan_settings),
            "seed": self.seed,
            "labels": digest(Path(self.labels).read_text(encoding="utf-8")),
            **{
                name: None if path is None else digest(Path(path).read_text(encoding="utf-8"))
                for name, path in lists.items()
            },
            # Names without file sizes, so that a failed scan can be downloaded again and retried
            # (`--retry-failed`) in the same folder.
            "scans": digest("\n".join(path.name for path in folders)),
        }

    def survey(self, run: Run) -> Survey:
        """List the scans on disk and their splits, without opening any scan."""
        folders = find_scans(self.scans)
        names = [path.name for path in folders]
        left_out: list[Line] = []
        if self.train or self.val:
            split_of, missing = split_scans(folders, self.train, self.val)
            for scan_ids, why in (
                ([name for name in names if name not in split_of], "it is in no list"),
                (missing, f"a list names it, but {self.scans} has no such folder"),
            ):
                left_out += [Line(name, name, "filtered", "split", why) for name in scan_ids]
        else:
            # Split by space, because rescans of a room must not be in both splits.
            half = seeded_split(list(dict.fromkeys(map(space_of, names))), self.seed)
            split_of = {name: half[space_of(name)] for name in names}
        tasks = tuple(RoomTask(name, name, split) for name, split in split_of.items())
        hint = "the lists" if self.train or self.val else ""
        where = f"{self.scans} is to be prepared"
        return select(Survey(tasks, tuple(left_out)), self.only, where, hint)

    def prepare(self, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | Line:
        """Read one scan and label its views."""
        labels = _labels(Path(self.labels), Path(self.labels).stat().st_mtime_ns)
        folder = Path(self.scans) / task.house
        scan = read_scan(folder, labels, self.scan_settings)
        made = prepare_scan(scan)
        if made is not None and not scan.is_aligned:
            made = self._turned(scan, made, labels)
        if made is None:
            why = f"none of its {len(scan.frames)} views shows any object"
            return Line(task.room_id, task.house, "filtered", "no_view", why, notes=[*scan.notes])
        return made

    def _turned(self, scan: Scan, made: PreparedRoom, labels: Labels) -> PreparedRoom:
        """Prepare a scan again, aligned with its walls, if the walls are not aligned with the
        axes."""
        degrees = find_turn(made.views)
        if degrees:
            scan = read_scan(scan.folder, labels, self.scan_settings, degrees)
            again = prepare_scan(scan)
            assert again is not None, "it was prepared before"
            world = scan.room_from_scan
            made = replace(
                again, views=replace(again.views, turned_deg=degrees, room_from_world=world)
            )
        return replace(made, notes=(*made.notes, *note_of_turn(degrees)))

    def _folders(self, only: str | None) -> list[Path]:
        chosen = [path for path in find_scans(self.scans) if house_may_match(only, path.name)]
        if not chosen:
            raise InputError(
                f"{self.scans} has no scan '{only}' (--only takes a scan, such as scene0000_00)."
            )
        return chosen


# The table is cached from room to room within a process; the stamp makes long-lived workers reread
# a changed table.
@functools.lru_cache(maxsize=1)
def _labels(path: Path, stamp: int) -> Labels:
    return read_labels(path)
