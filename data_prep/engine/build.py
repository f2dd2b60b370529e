"""Builds a folder of shards from a source, in parallel and resumable.

Every `prep-*` command runs this engine. It prepares the source's rooms shard by shard, as tasks
(core/parallel.py), and writes a report at the end. `plan.json` is written first, and of each
shard its models, its report and, last, the shard itself; files are whole or absent, so that a run
may be killed anywhere and resumed by the same command.
"""

import contextlib
import errno
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from data_prep.engine.plan import (
    PLAN_NAME,
    JobPlan,
    ShardTask,
    in_words,
    is_asked_for,
    job_settings,
    read_plan,
)
from data_prep.engine.report import (
    REPORT_FILES,
    REPORT_NAME,
    TABLE_NAME,
    Summary,
    line_of,
    report_csv,
)
from data_prep.engine.source import Line, PreparedRoom, Source, sentence_of
from sceneprior.core.errors import InputError
from sceneprior.core.files import (
    json_text,
    only_writer,
    remove_parts,
    write_changed,
    write_json,
    write_whole,
)
from sceneprior.core.observations import RoomGroundTruth, RoomViews
from sceneprior.core.parallel import check_shared, run_tasks
from sceneprior.core.scene import Mesh
from sceneprior.core.shard_writing import check_room, shard_bytes
from sceneprior.core.shards import INDEX_NAME, MODELS_FOLDER
from sceneprior.render.offscreen import Renderer, open_renderer

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


@dataclass(frozen=True)
class Job:
    """Arguments of a `prep-*` command. Only `source` and `renderer` affect the bytes written."""

    source: Source
    out: Path
    renderer: str = "auto"
    retry_failed: bool = False


def build_shards(job: Job) -> Summary:
    """Prepare a data set. A second run with the same settings makes only the missing shards."""
    source, out = job.source, Path(job.out)
    settings = job_settings(source, source.only)  # rejects wrong input folders before `out` exists
    with claimed(out):
        plan = read_plan(out, source, settings, job.renderer)
        if plan is None:
            tasks = {"opening a renderer": (job.renderer,)} if source.draws else {}
            settings["renderer"], *_ = [*run_tasks(_renderer_kind, tasks), None]
            survey = source.survey()
            plan = JobPlan(settings, survey.rooms, survey.left_out)
            with writing(out):
                write_json(out / PLAN_NAME, asdict(plan))
        elif job.retry_failed and any(line.status == "failed" for line in plan.left_out):
            plan = plan.joined(source.survey(), source.only, settings)
            with writing(out):
                write_json(out / PLAN_NAME, asdict(plan))
        return _carry_out(replace(job, out=out), plan)


def _renderer_kind(kind: str) -> str:
    return open_renderer(kind).kind


def _carry_out(job: Job, plan: JobPlan) -> Summary:
    source, out = job.source, job.out
    shards = plan.shards(source.room_type)
    reports: dict[str, ShardReport] = {}
    for shard in shards:
        report = read_finished(out / shard.name)
        if report is None or [line.room_id for line in report.lines] != shard.room_ids:
            continue  # unfinished, or rooms were added to it (`JobPlan.joined`)
        if not (job.retry_failed and report.has("failed")):
            reports[shard.name] = report
    kept = len(reports)
    missing = [shard for shard in _asked_for(source, plan, shards) if shard.name not in reports]
    if missing:
        with writing(out):
            # The folder must not look finished until its last shard is there again.
            for name in REPORT_FILES:
                (out / name).unlink(missing_ok=True)
    kind = plan.settings["renderer"]
    tasks = {_rooms_of(shard): (source, out, kind, shard) for shard in missing}
    made = run_tasks(make_shard, tasks, "preparing")
    reports |= zip((shard.name for shard in missing), made, strict=True)
    done = [reports[shard.name] for shard in shards if shard.name in reports]
    lines = [*plan.left_out, *(line for report in done for line in report.lines)]
    drawn = done[-1].renderer if done else kind
    open_shards = len(shards) - len(reports)
    totals = Summary(source, lines, drawn, len(missing), kept, open_shards)
    if not open_shards:
        _finish(out, plan, totals)
    if plan.settings["only"] == source.only:
        return totals
    # With `--only` in a larger folder, the summary covers the requested part alone.
    asked = [line for line in lines if is_asked_for(source.only, line.room_id, line.house)]
    return replace(totals, lines=asked)


def _asked_for(source: Source, plan: JobPlan, shards: list[ShardTask]) -> list[ShardTask]:
    """Shards that hold a room selected by `--only`, if the folder was planned without that option;
    otherwise all shards."""
    if plan.settings["only"] == source.only:
        return shards
    chosen = [
        shard
        for shard in shards
        if any(is_asked_for(source.only, room.room_id, room.house) for room in shard.rooms)
    ]
    if not chosen:
        whys = [
            f": {line.room_id}, {line.reason.rstrip('.')}"
            for line in plan.left_out
            if is_asked_for(source.only, line.room_id, line.house)
        ]
        raise InputError(
            f"--only {source.only} selects no room of the plan{whys[0] if whys else ''}."
        )
    return chosen


def _rooms_of(shard: ShardTask) -> str:
    return f"rooms {shard.rooms[0].room_id} to {shard.rooms[-1].room_id}"


@dataclass(frozen=True)
class ShardReport:
    """Outcome of a shard's rooms, as stored in `<shard>.report.json`."""

    renderer: str | None
    """Name of the renderer; None if nothing was drawn."""
    lines: list[Line]

    def has(self, status: str) -> bool:
        """Test whether any room has this status: prepared, filtered or failed."""
        return any(line.status == status for line in self.lines)


def make_shard(
    source: Source, out: Path, renderer_kind: str | None, shard: ShardTask
) -> ShardReport:
    """Prepare the rooms of one shard and write it.

    Models are written first, then the report, then the shard, so that a shard with a report is
    complete (`read_finished`).
    """
    check_shared(out / PLAN_NAME)
    path = out / shard.name
    with writing(out, _rooms_of(shard)):
        # The report is deleted first, so that the shard counts as unfinished if the job stops here.
        _report_path(path).unlink(missing_ok=True)
        path.unlink(missing_ok=True)
        renderer = None if renderer_kind is None else open_renderer(renderer_kind)
        report = ShardReport(renderer.name if renderer else None, [])
        rooms = _prepared(source, out, renderer, shard, report.lines)
        data = shard_bytes(shard.name, source.label_set, rooms)
        write_json(_report_path(path), asdict(report))
        if report.has("prepared"):
            write_whole(path, data)
    return report


def read_finished(shard: Path) -> ShardReport | None:
    """Read the report of a finished shard; None if the shard must still be made."""
    try:
        report = TypeAdapter(ShardReport).validate_json(_report_path(shard).read_bytes())
    except (OSError, ValidationError):
        return None
    return report if shard.is_file() or not report.has("prepared") else None


def _report_path(shard: Path) -> Path:
    return shard.with_suffix(".report.json")


def _prepared(
    source: Source, out: Path, renderer: Renderer | None, shard: ShardTask, lines: list[Line]
) -> Iterator[tuple[RoomViews, RoomGroundTruth | None]]:
    """Prepare the shard's rooms one by one, write their models, append outcomes to `lines`.

    Any exception becomes the failure of one room alone.
    """
    for task in shard.rooms:
        result: PreparedRoom | Line
        try:
            result = source.prepare(task, renderer)
            if isinstance(result, PreparedRoom):
                check_room(task.house, result.views, result.truth)
        except Exception as error:
            result = Line(task.room_id, task.house, "failed", reason=sentence_of(error))
        lines.append(line_of(result, task, source.label_set))
        if isinstance(result, Line):
            continue
        for model_id, mesh in result.models.items():
            path = out / MODELS_FOLDER / f"{model_id}.ply"
            if not path.is_file():
                write_whole(path, _ply_bytes(mesh))
        yield result.views, result.truth


def _ply_bytes(mesh: Mesh) -> bytes:
    import trimesh

    bare = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    return trimesh.exchange.ply.export_ply(bare, encoding="binary", vertex_normal=False)


def _finish(out: Path, plan: JobPlan, totals: Summary) -> None:
    """Write the report, then the index, which marks the folder as finished.

    If no room was prepared, or none of `train`, only the report is written and an `InputError`
    raised.
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
    why = in_words(line for line in totals.lines if line.status != "prepared")
    if planned and not totals.counts["train"]["rooms"]:
        raise InputError(
            f"The 'train' split is empty: all its rooms failed or were filtered ({why}); see "
            f"{out}/{TABLE_NAME}."
        )
    if not totals.statuses.get("prepared"):
        raise InputError(f"No room was prepared ({why}); see {out}/{TABLE_NAME}.")
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


@contextlib.contextmanager
def claimed(out: Path) -> Iterator[None]:
    """Lock `out` for this run, and remove the partial files of a killed run."""
    with contextlib.ExitStack() as until_done:
        with writing(out):
            until_done.enter_context(only_writer(out))
            remove_parts(out)
        try:
            yield
        finally:
            with contextlib.suppress(OSError):
                remove_parts(out)  # partial files of workers that died


@contextlib.contextmanager
def writing(out: Path, what: str = "") -> Iterator[None]:
    """Turn an OSError into an InputError that names the lost work, `what`, and how to continue."""
    try:
        yield
    except OSError as error:
        where = error.filename or out
        about = f" ({what})" if what else ""
        advice = "free space on the disk and " if error.errno in _FULL else ""
        raise InputError(
            f"{where}{about} cannot be written ({error.strerror or error}). "
            f"Finished shards are kept: {advice}run the same command again to continue."
        ) from None
