"""Builds a folder of shards from a source, in parallel and resumable.

Every `prep-*` command runs this engine. It prepares the source's rooms shard by shard
(shard_job.py) in worker processes (workers.py), and writes a report at the end.
"""

import os
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from data_prep.engine.output import claimed, writing
from data_prep.engine.plan import PLAN_NAME, Plan, ShardPlan, job_settings, read_plan
from data_prep.engine.report import REPORT_FILES, Summary, finish
from data_prep.engine.selection import is_asked_for
from data_prep.engine.shard_job import ShardReport, make_shard, read_finished
from data_prep.engine.source import Source
from data_prep.engine.workers import Run, pool
from sceneprior.core.errors import InputError
from sceneprior.core.files import write_json
from sceneprior.render.offscreen import open_renderer


@dataclass(frozen=True)
class Job:
    """Arguments of a `prep-*` command. Only `source` and `renderer` affect the bytes written."""

    source: Source
    out: Path
    workers: int | None = 1
    """Number of processes on this machine; 1 works in this process, None takes all cores."""
    renderer: str = "auto"
    retry_failed: bool = False


def build_shards(job: Job) -> Summary:
    """Prepare a data set. A second run with the same settings makes only the missing shards."""
    source, out = job.source, Path(job.out)
    settings = job_settings(source, source.only)  # rejects wrong input folders before `out` exists
    cores = len(os.sched_getaffinity(0))
    with claimed(out), pool(job.workers or cores) as run:
        plan = read_plan(out, source, settings, job.renderer)
        if plan is None:
            plan = _make_plan(source, settings, job, run)
            with writing(out):
                write_json(out / PLAN_NAME, asdict(plan))
        return _carry_out(replace(job, out=out), plan, run)


def _make_plan(source: Source, settings: dict[str, Any], job: Job, run: Run) -> Plan:
    kind = next(run(_renderer_kind, [(job.renderer,)], None)) if source.draws else None
    survey = source.survey(run)
    return Plan({**settings, "renderer": kind}, survey.rooms, survey.left_out)


def _renderer_kind(kind: str) -> str:
    return open_renderer(kind).kind


def _carry_out(job: Job, plan: Plan, run: Run) -> Summary:
    source, out = job.source, job.out
    shards = plan.shards(source.room_type)
    reports: dict[str, ShardReport] = {}
    for shard in shards:
        report = read_finished(out / shard.name)
        if report is not None and not (job.retry_failed and report.has("failed")):
            reports[shard.name] = report
    kept = len(reports)
    missing = [shard for shard in _asked_for(source, plan, shards) if shard.name not in reports]
    if missing:
        with writing(out):
            # The folder must not look finished until its last shard is there again.
            for name in REPORT_FILES:
                (out / name).unlink(missing_ok=True)
    kind = plan.settings["renderer"]
    arguments = [(source, out, kind, shard) for shard in missing]
    made = run(make_shard, arguments, "preparing") if missing else iter(())
    for shard, report in zip(missing, made, strict=True):
        reports[shard.name] = report
    done = [reports[shard.name] for shard in shards if shard.name in reports]
    lines = [*plan.left_out, *(line for report in done for line in report.lines)]
    drawn = done[-1].renderer if done else kind
    open_shards = len(shards) - len(reports)
    totals = Summary(source, lines, drawn, len(missing), kept, open_shards)
    if not open_shards:
        finish(out, plan, totals)
    if plan.settings["only"] == source.only:
        return totals
    # With `--only` in a larger folder, the summary covers the requested part alone.
    asked = [line for line in lines if is_asked_for(source.only, line.room_id, line.house)]
    return replace(totals, lines=asked)


def _asked_for(source: Source, plan: Plan, shards: list[ShardPlan]) -> list[ShardPlan]:
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
