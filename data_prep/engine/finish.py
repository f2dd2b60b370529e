"""Finishes a job: writes report.json, report.csv and, last, index.json."""

from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from data_prep.engine.output import writing
from data_prep.engine.plan import Plan
from data_prep.engine.report import Line, count_splits, make_report, report_csv
from data_prep.engine.source import Source
from sceneprior.core.errors import InputError
from sceneprior.core.files import json_text, write_changed
from sceneprior.core.shards import INDEX_NAME

REPORT_NAME = "report.json"
TABLE_NAME = "report.csv"
REPORT_FILES = (INDEX_NAME, REPORT_NAME, TABLE_NAME)
"""Files of a finished folder, in the order of their deletion when work begins again."""


@dataclass(frozen=True)
class Summary:
    """The totals of a job."""

    source: Source
    lines: list[Line]
    """One per room considered; with `--only` in a larger folder, one per requested room."""
    renderer: str | None
    """Name of the renderer; None if nothing was drawn."""
    shards_made: int
    shards_kept: int
    shards_open: int
    """Planned shards that `--only` left for later; the folder is unfinished while there are any."""

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Numbers of rooms, views and objects per split."""
        return count_splits(self.lines)

    @property
    def statuses(self) -> dict[str, int]:
        """Numbers of rooms that were prepared, filtered, failed."""
        return dict(Counter(line.status for line in self.lines))

    @property
    def report(self) -> dict[str, Any]:
        """Contents of `report.json`."""
        about = {
            "source": self.source.name,
            "room_type": self.source.room_type,
            "label_set": self.source.label_set,
            "renderer": self.renderer,
            "summary": str(self),
        }
        # The expected counts are those of the whole data set.
        expected = self.source.expected if self.source.only is None else None
        return make_report(self.lines, about, expected)

    def __str__(self) -> str:
        parts = [
            f"{split} {count['rooms']} rooms, {count['views']} views, {count['objects']} objects"
            for split, count in self.counts.items()
            if count["rooms"]
        ]
        left_out = ", ".join(
            f"{self.statuses[status]} {status}"
            for status in ("filtered", "failed")
            if self.statuses.get(status)
        )
        return "; ".join(parts) + (f"; {left_out} ({TABLE_NAME} says why)" if left_out else "")


def finish(out: Path, plan: Plan, totals: Summary) -> None:
    """Write the report, then the index, which marks the folder as finished.

    Without any prepared room, or any of `train`, only the report is written: an `InputError`.
    """
    if plan.settings["only"] is None and totals.source.only is not None:
        # A run with `--only` made the last missing shard: report on the whole data set.
        whole: Any = replace(totals.source, only=None)  # type: ignore[type-var]
        totals = replace(totals, source=whole)
    with writing(out):
        write_changed(out / REPORT_NAME, json_text(totals.report))
        write_changed(out / TABLE_NAME, report_csv(totals.lines))
    # Rules on mesh positions may leave a small `val` or `test` empty, but not `train`.
    planned = any(room.split == "train" for room in plan.rooms) and plan.settings["only"] is None
    if planned and not totals.counts["train"]["rooms"]:
        raise InputError(
            f"The 'train' split is empty: all its rooms failed or were filtered; see "
            f"{out}/{TABLE_NAME}."
        )
    if not totals.statuses.get("prepared"):
        raise InputError(f"No room was prepared; {out}/{TABLE_NAME} says why.")
    index = {
        "format": "sceneprior-shards",
        "version": 1,
        "source": totals.source.name,
        "label_set": totals.source.label_set,
        "room_type": totals.source.room_type,
        "counts": totals.counts,
        "seed": plan.settings.get("seed"),
        "recipe": plan.settings.get("recipe"),
        "renderer": totals.renderer,
    }
    with writing(out):
        write_changed(out / INDEX_NAME, json_text(index))
