"""Makes one shard: prepares its rooms, then writes their models, a report, and the shard."""

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from data_prep.engine.output import writing
from data_prep.engine.plan import ShardPlan
from data_prep.engine.report import line_of
from data_prep.engine.source import Line, PreparedRoom, RoomTask, Source, sentence_of
from sceneprior.core.files import write_json, write_whole
from sceneprior.core.scene import Mesh
from sceneprior.core.shard_writing import check_views, shard_bytes
from sceneprior.core.shards import MODELS_FOLDER, RoomGroundTruth, RoomViews
from sceneprior.render.offscreen import Renderer, open_renderer


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
    source: Source, out: Path, renderer_kind: str | None, shard: ShardPlan
) -> ShardReport:
    """Prepare the rooms of one shard and write it.

    Models are written first, then the report, then the shard, so that a shard with a report is
    complete (`read_finished`).
    """
    path = out / shard.name
    first, last = shard.rooms[0].room_id, shard.rooms[-1].room_id
    with writing(out, f"rooms {first} to {last}"):
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
    source: Source,
    out: Path,
    renderer: Renderer | None,
    shard: ShardPlan,
    lines: list[Line],
) -> Iterator[tuple[RoomViews, RoomGroundTruth | None]]:
    """Prepare the shard's rooms one by one, write their models, append outcomes to `lines`."""
    for task in shard.rooms:
        result = _prepare(source, task, renderer)
        line = line_of(result, task, source.label_set)
        lines.append(line)
        if isinstance(result, Line):
            continue
        for model_id, mesh in result.models.items():
            _write_model(out / MODELS_FOLDER / f"{model_id}.ply", mesh)
        for name, data in result.files.items():
            write_whole(out / name, data)
        yield result.views, result.truth


def _prepare(source: Source, task: RoomTask, renderer: Renderer | None) -> PreparedRoom | Line:
    """Prepare one room; any exception becomes the failure of this room alone."""
    try:
        result = source.prepare(task, renderer)
        if isinstance(result, PreparedRoom):
            check_views(task.house, result.views)
        return result
    except Exception as error:
        return Line(task.room_id, task.house, "failed", reason=sentence_of(error))


def _write_model(path: Path, mesh: Mesh) -> None:
    if path.is_file():
        return
    import trimesh

    bare = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    write_whole(path, trimesh.exchange.ply.export_ply(bare, encoding="binary", vertex_normal=False))
