"""Many houses in, shards out: in parallel, resumable, with a report that names what was skipped."""

import csv
import hashlib
import io
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from data_prep.drawing import prepare_room
from data_prep.front3d import HouseRooms, ModelBank, house_files, read_house
from data_prep.recipe import Recipe, category_classes
from data_prep.rooms import Room
from data_prep.viewpoints import view_counts
from data_prep.workers import Run, pool
from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.offscreen import open_renderer
from sceneprior.scene import Mesh
from sceneprior.shards import INDEX_NAME, MODELS_FOLDER, write_shard

PLAN_NAME = "plan.json"
PLAN_VERSION = 1
ROOMS_PER_SHARD = 8
SPLITS = ("train", "test")
_TEST_SHARE = 0.1


@dataclass(frozen=True)
class FrontJob:
    """What `prep-front` was asked for."""

    front: Path
    future: Path
    out: Path
    recipe: Recipe
    splits: Path | None = None
    """CSV of `room id,split`; None: a seeded 9:1."""
    seed: int = 0
    workers: int = 1
    renderer: str = "auto"
    only: str | None = None
    """HOUSE, HOUSE/ROOM or a room id; the beginning of a house's name is enough."""
    val: str = "train"
    """Which split the rows `val` of `splits` join: train, test or none."""


@dataclass(frozen=True)
class Summary:
    """The totals of a finished job."""

    counts: dict[str, dict[str, int]]
    """Per split: rooms, views, objects."""
    statuses: dict[str, int]
    """How many rooms were prepared, filtered, failed."""
    renderer: str
    shards_made: int
    shards_kept: int

    def __str__(self) -> str:
        parts = [
            f"{split} {count['rooms']} rooms, {count['views']} views, {count['objects']} objects"
            for split, count in self.counts.items()
        ]
        left_out = ", ".join(
            f"{self.statuses[status]} {status}"
            for status in ("filtered", "failed")
            if self.statuses.get(status)
        )
        return "; ".join(parts) + (f"; {left_out} (report.csv says why)" if left_out else "")


@dataclass
class _RoomPlan:
    """One room the survey kept."""

    room_id: str
    house: str
    area_m2: float
    views: int = 0
    split: str = ""


@dataclass
class _Line:
    """One line of the report."""

    room_id: str
    house: str
    status: str
    """prepared, filtered or failed."""
    reason: str = ""
    split: str = ""
    views: int = 0
    objects: int = 0
    notes: list[str] = field(default_factory=list)
    classes: dict[str, int] = field(default_factory=dict)


def build_shards(job: FrontJob) -> Summary:
    """Prepare a whole data set. A second run with the same settings makes only what is missing.

    Raises:
        InputError: a folder is wrong, a split is empty, `out` holds shards of other settings or
            cannot be written.
    """
    if job.val not in ("train", "test", "none"):
        raise InputError(f"'{job.val}' is not where val rooms can go; choose train, test or none.")
    ModelBank(job.future)  # a wrong folder is told before any work
    files = _chosen_houses(job)
    split_of_id = None if job.splits is None else _read_splits(job.splits, job.val)
    plan = _read_plan(job, _settings(job, files))
    try:
        with pool(job.workers) as run:
            if plan is None:
                plan = _make_plan(job, files, split_of_id, run)
            tasks = _shard_tasks(plan)
            missing = [task for task in tasks if not _finished(job.out / task[0])]
            kind = plan["settings"]["renderer"]
            arguments = [
                (job.front, job.future, job.out, job.recipe, job.seed, kind, *task)
                for task in missing
            ]
            for _ in run(_make_shard, arguments, "rendering"):
                pass
        return _finish(job, plan, tasks, len(missing))
    except OSError as error:
        raise InputError(
            f"{error.filename or job.out} cannot be written ({error.strerror or error}). "
            "Finished shards are kept: run the same command again to go on."
        ) from None


def _make_plan(
    job: FrontJob, files: list[Path], split_of_id: dict[str, str] | None, run: Run
) -> dict[str, Any]:
    kind = next(run(_renderer_kind, [(job.renderer,)], None))
    rooms, lines = _survey(job, files, split_of_id, run)
    plan = {
        "settings": {**_settings(job, files), "renderer": kind},
        "rooms": [asdict(room) for room in rooms],
        "left_out": [asdict(line) for line in lines],
    }
    _write_json(job.out / PLAN_NAME, plan)
    return plan


# --- which rooms -------------------------------------------------------------------------------


def _chosen_houses(job: FrontJob) -> list[Path]:
    files = house_files(job.front)
    if job.only is None:
        return files
    house = job.only.partition("/")[0]
    chosen = [
        path
        for path in files
        if path.stem.startswith(house) or job.only.startswith(f"{path.stem}_")
    ]
    if not chosen:
        raise InputError(
            f"{job.front} has no house '{house}' (--only takes HOUSE, HOUSE/ROOM or ID)."
        )
    return chosen


def _is_asked_for(only: str | None, room_id: str, house: str) -> bool:
    if only is None:
        return True
    start, slash, room = only.partition("/")
    if slash:
        return house.startswith(start) and room_id == f"{house}_{room}"
    return house.startswith(start) or room_id == only


def _read_splits(path: Path, val: str) -> dict[str, str]:
    try:
        rows = list(csv.reader(io.StringIO(Path(path).read_text())))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"No split file can be read at {path} ({error}).") from None
    meaning = {"train": "train", "test": "test", "val": val, "validation": val}
    found = {
        row[0].strip(): meaning[row[1].strip().lower()]
        for row in rows
        if len(row) >= 2 and row[1].strip().lower() in meaning
    }
    if not found:
        raise InputError(f"{path} has no rows `room id,split` with split train, val or test.")
    return found


def _survey(
    job: FrontJob, files: list[Path], split_of_id: dict[str, str] | None, run: Run
) -> tuple[list[_RoomPlan], list[_Line]]:
    """Read every house once, without meshes, and decide which rooms are worth drawing."""
    kept: list[_RoomPlan] = []
    lines: list[_Line] = []
    arguments = [(job.future, job.recipe, files[i : i + 8]) for i in range(0, len(files), 8)]
    for rooms, left_out in run(_survey_houses, arguments, "reading houses"):
        kept += rooms
        lines += left_out
    if split_of_id is None:
        split_of_id = _seeded_split([room.room_id for room in kept], job.seed)
    rooms = []
    for room in kept:
        bare = room.room_id.removeprefix(f"{room.house}_")
        room.split = split_of_id.get(room.room_id, split_of_id.get(bare, ""))
        if not _is_asked_for(job.only, room.room_id, room.house):
            continue
        if room.split in SPLITS:
            rooms.append(room)
        else:
            lines.append(_Line(room.room_id, room.house, "filtered", "it is in no split"))
    lines = [line for line in lines if _is_asked_for(job.only, line.room_id, line.house)]
    if not rooms:
        raise InputError(_nothing_left(job, lines))
    for split in SPLITS:
        if job.only is None and not any(room.split == split for room in rooms):
            raise InputError(
                f"The '{split}' split is empty: none of the {len(rooms)} usable rooms is in it. "
                f"Check {job.splits or 'that the data set has more than one usable room'}."
            )
    return rooms, lines


def _nothing_left(job: FrontJob, lines: list[_Line]) -> str:
    # Reasons that differ only in their numbers are one; the first stands for all.
    shapes = Counter(re.sub(r"[\d.]+", "#", line.reason) for line in lines)
    often = ""
    if shapes:
        shape = shapes.most_common(1)[0][0]
        often = next(x.reason for x in lines if re.sub(r"[\d.]+", "#", x.reason) == shape)
        often = f"; most often as here: {often.rstrip('.')}"
    where = f" for --only {job.only}" if job.only else ""
    return (
        f"No room of {job.front} passes the recipe {job.recipe.name}{where} "
        f"({len(lines)} were left out{often})."
    )


def _seeded_split(room_ids: Sequence[str], seed: int) -> dict[str, str]:
    """Nine rooms of ten train; an id keeps its place in the order whatever else is there."""
    order = sorted(room_ids, key=lambda item: hashlib.sha256(f"{seed}:{item}".encode()).digest())
    tests = round(_TEST_SHARE * len(order)) or min(1, len(order) - 1)
    return {room_id: "test" if i < tests else "train" for i, room_id in enumerate(order)}


def _survey_houses(
    future: Path, recipe: Recipe, files: list[Path]
) -> tuple[list[_RoomPlan], list[_Line]]:
    kept: list[_RoomPlan] = []
    lines: list[_Line] = []
    for path in files:
        house = path.stem
        try:
            read = _read(path, future, recipe, load_models=False)
        except InputError as error:
            lines.append(_Line(house, house, "failed", str(error)))
            continue
        lines += [_Line(room_id, house, "failed", why) for room_id, why in read.failures]
        lines += [_Line(room_id, house, "filtered", why) for room_id, why in read.filtered]
        good = []
        for room in read.rooms:
            why = _left_out_because(room, recipe)
            if why:
                lines.append(_Line(room.room_id, house, "filtered", why, notes=list(room.notes)))
            else:
                good.append(room)
        areas = [float(room.floor.area) for room in good]
        kept += [
            _RoomPlan(room.room_id, house, area, views)
            for room, area, views in zip(good, areas, view_counts(areas, recipe.views), strict=True)
        ]
    return kept, lines


def _read(
    path: Path,
    future: Path,
    recipe: Recipe,
    load_models: bool,
    wanted: Callable[[str, str], bool] | None = None,
) -> HouseRooms:
    return read_house(
        path,
        _bank(future),
        category_classes(recipe.class_column),
        wanted or (lambda _, room_type: recipe.of_type(room_type)),
        recipe.scale_range,
        load_models,
    )


_banks: dict[Path, ModelBank] = {}  # one a process: each model is read once


def _bank(future: Path) -> ModelBank:
    if future not in _banks:
        _banks[future] = ModelBank(future)
    return _banks[future]


def _left_out_because(room: Room, recipe: Recipe) -> str:
    """The first rule that the room breaks, as a sentence; empty if it breaks none."""
    labels = [piece.label for piece in room.furniture if piece.label != "void"]
    x1, z1, x2, z2 = room.floor.bounds
    if recipe.min_objects is not None and len(labels) < recipe.min_objects:
        return f"{len(labels)} objects, min_objects is {recipe.min_objects}"
    if recipe.max_objects is not None and len(labels) > recipe.max_objects:
        return f"{len(labels)} objects, max_objects is {recipe.max_objects}"
    if recipe.required_classes and not set(labels) & set(recipe.required_classes):
        return f"none of {', '.join(recipe.required_classes)}, which required_classes asks for"
    if recipe.max_floor_m is not None and max(x2 - x1, z2 - z1) > recipe.max_floor_m:
        return f"floor {x2 - x1:.2f} x {z2 - z1:.2f} m, max_floor_m is {recipe.max_floor_m:g}"
    if recipe.max_height_m is not None and room.height_m > recipe.max_height_m:
        return f"height {room.height_m:.2f} m, max_height_m is {recipe.max_height_m:g}"
    return ""


# --- the plan ----------------------------------------------------------------------------------


def _settings(job: FrontJob, files: list[Path]) -> dict[str, Any]:
    """What the shards' bytes depend on. Paths and worker counts do not matter."""
    sizes = "".join(f"{path.name} {path.stat().st_size}\n" for path in files)
    splits = None if job.splits is None else _digest(Path(job.splits).read_text())
    recipe = json.loads(json.dumps(asdict(job.recipe)))
    return {
        "plan_version": PLAN_VERSION,
        "recipe": recipe,
        "seed": job.seed,
        "only": job.only,
        "val": job.val,
        "splits": splits,
        "houses": _digest(sizes),
    }


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _read_plan(job: FrontJob, settings: dict[str, Any]) -> dict[str, Any] | None:
    """The plan of an earlier run, or None; `auto` goes on with the renderer that run had."""
    path = job.out / PLAN_NAME
    if not path.is_file():
        if any(job.out.glob("*/*.h5")) or (job.out / INDEX_NAME).exists():
            raise InputError(f"{job.out} holds shards without a {PLAN_NAME}; choose a new folder.")
        return None
    try:
        plan = json.loads(path.read_text())
        before = dict(plan["settings"])
        renderer = before.pop("renderer")
    except (OSError, ValueError, KeyError, TypeError):
        raise InputError(
            f"{path} cannot be read; choose a new folder, or delete {job.out}."
        ) from None
    changed = [key for key in settings if before.get(key) != settings[key]]
    if job.renderer not in ("auto", renderer):
        changed.append("renderer")
    if changed:
        raise InputError(
            f"{job.out} was begun with other settings ({', '.join(changed)} differ); "
            "give --out a new folder, or delete this one."
        )
    return plan


def _shard_tasks(plan: dict[str, Any]) -> list[tuple[str, list[_RoomPlan]]]:
    """(shard name, its rooms): a few rooms a shard, in the order of the houses."""
    tasks = []
    word = plan["settings"]["recipe"]["name"].removeprefix("front3d_")
    for split in SPLITS:
        rooms = [_RoomPlan(**room) for room in plan["rooms"] if room["split"] == split]
        for i in range(0, len(rooms), ROOMS_PER_SHARD):
            name = f"{split}/{word}_{i // ROOMS_PER_SHARD:04d}.h5"
            tasks.append((name, rooms[i : i + ROOMS_PER_SHARD]))
    return tasks


def _report_path(shard: Path) -> Path:
    return shard.with_suffix(".report.json")


def _finished(shard: Path) -> bool:
    """The report of a shard is written before the shard moves into place."""
    try:
        report = json.loads(_report_path(shard).read_text())
    except (OSError, ValueError):
        return False
    return shard.is_file() or not any(line["status"] == "prepared" for line in report["lines"])


def _write_json(path: Path, data: Any) -> None:
    _write_whole(path, (json.dumps(data, indent=1) + "\n").encode())


def _write_whole(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(data)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def _renderer_kind(kind: str) -> str:
    return open_renderer(kind).kind


# --- one shard ---------------------------------------------------------------------------------


def _make_shard(
    front: Path,
    future: Path,
    out: Path,
    recipe: Recipe,
    seed: int,
    renderer_kind: str,
    name: str,
    plans: list[_RoomPlan],
) -> None:
    renderer = open_renderer(renderer_kind)
    read: dict[str, Room] = {}
    lines: dict[str, _Line] = {}
    ids = {plan.room_id for plan in plans}
    for path in [front / f"{house}.json" for house in dict.fromkeys(p.house for p in plans)]:
        try:
            house = _read(path, future, recipe, True, lambda room_id, _: room_id in ids)
        except InputError as error:
            failures = [(p.room_id, str(error)) for p in plans if p.house == path.stem]
            house = HouseRooms(failures=failures)
        read |= {room.room_id: room for room in house.rooms}
        for room_id, why in house.failures + house.filtered:
            lines[room_id] = _Line(room_id, path.stem, "failed", why)
    rooms = []
    for plan in plans:
        if plan.room_id not in read:
            lines.setdefault(
                plan.room_id,
                _Line(plan.room_id, plan.house, "failed", "its house lost it meanwhile"),
            )
            continue
        room = read[plan.room_id]
        line = _Line(plan.room_id, plan.house, "prepared", split=plan.split, notes=list(room.notes))
        lines[plan.room_id] = line
        # The survey saw no meshes: a model that turns out unreadable may leave too little.
        why = _left_out_because(room, recipe)
        made = None if why else prepare_room(room, plan.views, recipe, seed, renderer)
        if made is None:
            line.status, line.reason = "filtered", why or "no view shows any object"
            continue
        views = made[0]
        names = label_set(recipe.label_set)
        line.views, line.objects = len(views.boxes), len(views.object_class)
        line.classes = dict(Counter(names[index] for index in views.object_class))
        for piece in room.furniture:
            if piece.label != "void":
                _write_model(out / MODELS_FOLDER / f"{piece.model_id}.ply", piece.model)
        rooms.append(made)
    report = {
        "renderer": renderer.name,
        "lines": [asdict(lines[plan.room_id]) for plan in plans],
    }
    _write_json(_report_path(out / name), report)
    if rooms:
        write_shard(out / name, recipe.label_set, rooms)


def _write_model(path: Path, mesh: Mesh) -> None:
    if path.is_file():
        return
    import trimesh

    bare = trimesh.Trimesh(mesh.vertices_m, mesh.faces, process=False)
    _write_whole(
        path, trimesh.exchange.ply.export_ply(bare, encoding="binary", vertex_normal=False)
    )


# --- the end of the job ------------------------------------------------------------------------


def _finish(job: FrontJob, plan: dict[str, Any], tasks: list[Any], made: int) -> Summary:
    """Write report.json, report.csv and, last of all, index.json."""
    lines = [dict(line) for line in plan["left_out"]]
    renderer = plan["settings"]["renderer"]
    for name, _ in tasks:
        report = json.loads(_report_path(job.out / name).read_text())
        renderer = report["renderer"]
        lines += report["lines"]
    prepared = [line for line in lines if line["status"] == "prepared"]
    counts = {
        split: {
            "rooms": sum(line["split"] == split for line in prepared),
            "views": sum(line["views"] for line in prepared if line["split"] == split),
            "objects": sum(line["objects"] for line in prepared if line["split"] == split),
        }
        for split in SPLITS
    }
    statuses = dict(Counter(line["status"] for line in lines))
    summary = Summary(counts, statuses, renderer, made, len(tasks) - made)
    classes: Counter[str] = Counter()
    for line in prepared:
        classes.update(line["classes"])
    _write_json(
        job.out / "report.json",
        {"summary": str(summary), "counts": counts, "statuses": statuses,
         "classes": dict(sorted(classes.items())), "rooms": lines},
    )  # fmt: skip
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    columns = ["room_id", "house", "split", "status", "reason", "views", "objects"]
    writer.writerow([*columns, "notes"])
    for line in lines:
        writer.writerow([*(line[key] for key in columns), " | ".join(line["notes"])])
    _write_whole(job.out / "report.csv", table.getvalue().encode())
    for split in SPLITS:
        if job.only is None and not counts[split]["rooms"]:
            raise InputError(
                f"The '{split}' split is empty: all its rooms failed; see {job.out}/report.csv."
            )
    if not prepared:
        raise InputError(f"No room was prepared; {job.out}/report.csv says why.")
    _write_json(
        job.out / INDEX_NAME,
        {
            "format": "sceneprior-shards",
            "version": 1,
            "source": "3d-front",
            "label_set": job.recipe.label_set,
            "room_type": job.recipe.name.removeprefix("front3d_"),
            "counts": counts,
            "seed": job.seed,
            "recipe": plan["settings"]["recipe"],
            "renderer": renderer,
        },
    )
    return summary
