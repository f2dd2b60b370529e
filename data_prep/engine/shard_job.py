"""What a worker does: the rooms of one shard in; its models, its report and the shard out."""

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path, PurePosixPath

from data_prep.engine.output import writing
from data_prep.engine.plan import PLAN_NAME, ShardPlan
from data_prep.engine.report import Line, line_of, read_line
from data_prep.engine.source import LeftOut, PreparedRoom, RoomTask, Source, sentence_of
from sceneprior.errors import InputError
from sceneprior.files import write_json, write_whole
from sceneprior.offscreen import Renderer, open_renderer
from sceneprior.scene import Mesh
from sceneprior.shards import (
    MODELS_FOLDER,
    RoomGroundTruth,
    RoomViews,
    check_views,
    shard_bytes,
)

ShardReport = tuple[str | None, list[Line]]
"""The renderer's name (None where nothing was drawn), and a line for each room."""


class RoomFailedError(InputError):
    """A room failed, and `--strict` stops there."""

    @classmethod
    def of(cls, line: Line) -> "RoomFailedError":
        """The sentence about a failed line."""
        return cls(
            f"Room {line.room_id} failed: {line.reason.rstrip('.')}. --strict stops here; finished "
            "shards are kept, and the same command without --strict goes on."
        )


def make_shard(
    source: Source, out: Path, renderer_kind: str | None, shard: ShardPlan, strict: bool
) -> ShardReport:
    """Prepare the rooms of one shard and write it.

    Models come first, then the shard's report, then the shard: where report and shard are, all of
    it is there (`read_finished`).

    Raises:
        RoomFailedError: a room failed, with `strict`; nothing of the shard is written.
        InputError: `out` cannot be written, or is not the folder that the job sees.
    """
    if not (out / PLAN_NAME).is_file():
        raise InputError(
            f"A worker finds no {PLAN_NAME} in {out}: workers must reach the folders of the data "
            "and of the shards under the same paths as this machine."
        )
    first, last = shard.rooms[0].room_id, shard.rooms[-1].room_id
    with writing(out, f"rooms {first} to {last}"):
        # A report without its shard is "not finished" whatever stops us from here on.
        _report_path(out / shard.name).unlink(missing_ok=True)
        (out / shard.name).unlink(missing_ok=True)
        renderer = None if renderer_kind is None else open_renderer(renderer_kind)
        lines: list[Line] = []
        rooms = _prepared(source, out, renderer, shard, strict, lines)
        data = shard_bytes(shard.name, source.label_set, rooms)
        name = renderer.name if renderer else None
        write_json(
            _report_path(out / shard.name),
            {"renderer": name, "lines": [asdict(line) for line in lines]},
        )
        if any(line.status == "prepared" for line in lines):
            write_whole(out / shard.name, data)
    return name, lines


def read_finished(shard: Path) -> ShardReport | None:
    """The report of a shard that is whole; None if there is work to do."""
    try:
        report = json.loads(_report_path(shard).read_text())
        name, lines = report["renderer"], [read_line(line) for line in report["lines"]]
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if any(line.status == "prepared" for line in lines) and not shard.is_file():
        return None
    return name, lines


def _report_path(shard: Path) -> Path:
    return shard.with_suffix(".report.json")


def _prepared(
    source: Source,
    out: Path,
    renderer: Renderer | None,
    shard: ShardPlan,
    strict: bool,
    lines: list[Line],
) -> Iterator[tuple[RoomViews, RoomGroundTruth | None]]:
    """The shard's rooms one by one, their models written; what becomes of each goes to `lines`."""
    for task in shard.rooms:
        result = _prepare(source, task, renderer)
        line = line_of(result, task, source.label_set)
        if strict and line.status == "failed":
            raise RoomFailedError.of(line)
        lines.append(line)
        if isinstance(result, LeftOut):
            continue
        for model_id, mesh in result.models.items():
            _write_model(out / MODELS_FOLDER / f"{model_id}.ply", mesh)
        for name, data in result.files.items():
            write_whole(out / name, data)
        yield result.views, result.truth


def _prepare(source: Source, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | LeftOut:
    """One room; whatever goes wrong with it is this room's failure and no other's."""
    try:
        result = source.prepare(task, renderer)
        if isinstance(result, PreparedRoom):
            check_views(task.house, result.views)
            for name in [*result.files, *(f"{model_id}.ply" for model_id in result.models)]:
                path = PurePosixPath(name)
                if path.is_absolute() or ".." in path.parts:
                    raise InputError(f"its file '{name}' would lie outside the folder of shards")
        return result
    except Exception as error:
        return LeftOut(task.room_id, task.house, "failed", sentence_of(error))


def _write_model(path: Path, mesh: Mesh) -> None:
    if path.is_file():
        return
    import trimesh

    bare = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    write_whole(path, trimesh.exchange.ply.export_ply(bare, encoding="binary", vertex_normal=False))
