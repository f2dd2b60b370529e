"""Makes one shard: prepares its rooms, and writes their models, the shard's report, the shard."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

from pydantic import TypeAdapter, ValidationError

from data_prep.engine.output import writing
from data_prep.engine.plan import PLAN_NAME, ShardPlan
from data_prep.engine.report import Line, line_of
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


@dataclass(frozen=True)
class ShardReport:
    """What became of a shard's rooms, as `<shard>.report.json` keeps it."""

    renderer: str | None
    """Its name; None where nothing was drawn."""
    lines: list[Line]
    """One a room."""

    def has(self, status: str) -> bool:
        """Whether a room was prepared, filtered or failed."""
        return any(line.status == status for line in self.lines)


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
    path = out / shard.name
    first, last = shard.rooms[0].room_id, shard.rooms[-1].room_id
    with writing(out, f"rooms {first} to {last}"):
        # A report without its shard is "not finished" whatever stops us from here on.
        _report_path(path).unlink(missing_ok=True)
        path.unlink(missing_ok=True)
        renderer = None if renderer_kind is None else open_renderer(renderer_kind)
        report = ShardReport(renderer.name if renderer else None, [])
        rooms = _prepared(source, out, renderer, shard, strict, report.lines)
        data = shard_bytes(shard.name, source.label_set, rooms)
        write_json(_report_path(path), asdict(report))
        if report.has("prepared"):
            write_whole(path, data)
    return report


def read_finished(shard: Path) -> ShardReport | None:
    """The report of a shard that is whole; None if there is work to do."""
    try:
        report = TypeAdapter(ShardReport).validate_json(_report_path(shard).read_bytes())
    except (OSError, ValidationError):
        return None
    return report if shard.is_file() or not report.has("prepared") else None


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
