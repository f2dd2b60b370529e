"""Reference scenes: the ground-truth rooms of shards, and random baselines drawn from them."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np

from sceneprior.core.classes import VOID, label_set
from sceneprior.core.errors import InputError, ShardError
from sceneprior.core.files import check_file, file_stamp, reading
from sceneprior.core.scene import Mesh, Scene, SceneObject, Turned, mesh_of_file
from sceneprior.core.shards import MODELS_FOLDER, Shard, iterate_rooms, splits_of


def reference_scenes(
    shards: Path,
    split: str,
    limit: int | None = None,
    tracked_only: bool = False,
    meshes: bool = True,
) -> list[Scene]:
    """Ground-truth rooms of a split, in the order of the shards.

    `tracked_only` leaves out furniture that no camera saw, for comparison with decoded training
    rooms. Without `meshes`, objects are boxes, which take much less memory.
    """
    return [
        reference_scene(*room, shards, tracked_only, meshes)
        for room in islice(iterate_rooms(shards, split), limit)
    ]


def known_in_3d(shards: Path, split: str) -> bool:
    """True if a split has rooms, and all have ground truth; rooms of posed pictures have none."""
    return split in splits_of(shards) and all(
        shard.has_ground_truth(room_id) for shard, room_id in iterate_rooms(shards, split)
    )


def models_of(shards: Path, split: str) -> dict[str, tuple[str, ...]]:
    """Model ids of the furniture in each room; "" for a piece without a model."""
    return {
        room_id: shard.read_ground_truth(room_id).model_ids
        for shard, room_id in iterate_rooms(shards, split)
    }


def stream_scenes(shards: Path, split: str, rows: Collection[int]) -> Iterator[Scene]:
    """Yield the rooms with these indices in `reference_scenes`, with meshes, one at a time."""
    for row, room in enumerate(iterate_rooms(shards, split)):
        if row > max(rows):
            return
        if row in rows:
            yield reference_scene(*room, shards)


def independent_rooms(real: Sequence[Scene], count: int, seed: int) -> list[Scene]:
    """Sample rooms from the marginals of real rooms: a baseline without object relations.

    A room has as many objects as a randomly chosen real room. Each object is drawn from the objects
    of all real rooms, and keeps its class, box, position and mesh, if it has one. So every single
    object is real, but the objects of a room are independent of each other. Floor and ceiling are
    those of the real room that determines the number of objects.
    """
    pool = [item for scene in real for item in scene.objects]
    if not pool:
        raise InputError(
            "Independent rooms are drawn from the objects of real rooms, but none of the "
            f"{len(real)} rooms given holds any; give the training rooms of prepared shards."
        )
    generator = np.random.default_rng(seed)
    chosen = [real[row] for row in generator.choice(len(real), size=count)]
    return [
        Scene(
            f"independent_{index:04d}",
            real[0].label_set,
            tuple(pool[pick] for pick in generator.integers(len(pool), size=len(like.objects))),
            like.floor_m,
            ceiling_m=like.ceiling_m,
        )
        for index, like in enumerate(chosen)
    ]


def shuffled_rooms(real: Sequence[Scene], count: int, seed: int) -> list[Scene]:
    """Real rooms with shuffled positions: a baseline with real contents but random layouts.

    Each object takes the x and z of an object drawn at random from all rooms, and keeps its own
    height; the room keeps its floor and ceiling. The rooms are drawn without replacement.
    """
    generator = np.random.default_rng(seed)
    places = [item.center_m for scene in real for item in scene.objects]
    rooms: list[Scene] = []
    for row in generator.permutation(len(real))[:count]:
        like = real[row]
        chosen = generator.integers(len(places), size=len(like.objects))
        objects = []
        for item, pick in zip(like.objects, chosen, strict=True):
            center_m = (places[pick][0], item.center_m[1], places[pick][2])
            objects.append(replace(item.in_box(center_m, item.size_m), turned=item.turned))
        name = f"shuffled_{len(rooms):04d}"
        rooms.append(
            Scene(name, like.label_set, tuple(objects), like.floor_m, ceiling_m=like.ceiling_m)
        )
    return rooms


def reference_scene(
    shard: Shard, room_id: str, shards: Path, tracked_only: bool = False, meshes: bool = True
) -> Scene:
    """Ground truth of one room of an open shard, without void furniture; see `reference_scenes`."""
    truth = shard.read_ground_truth(room_id)
    names = label_set(shard.label_set)
    count = len((shard.read_room(room_id) if tracked_only else truth).object_class)
    objects = []
    for row in np.flatnonzero(truth.object_class[:count] != VOID):
        mesh = None
        if meshes:
            mesh = _placed(Path(shards), truth.model_ids[row], truth.model_to_room[row])
        label = names[int(truth.object_class[row])]
        box = tuple(truth.centers_m[row].tolist()), tuple(truth.sizes_m[row].tolist())
        turned = _turned(float(truth.yaw_rad[row]), box[1])
        objects.append(SceneObject(label, *box, mesh, turned))
    floor = np.asarray(truth.floor_m, dtype=np.float64)
    extra = {"room_id": room_id, "height_m": truth.height_m}
    return Scene(
        room_id, shard.label_set, tuple(objects), floor, extra, ceiling_m=float(truth.height_m)
    )


def _turned(yaw_rad: float, size_m: Sequence[float]) -> Turned:
    """The upright box at a yaw whose axis-aligned box has given extents; near 45 degrees, where
    they do not determine it, the one with a square base."""
    width, height, depth = size_m
    cosine, sine = abs(np.cos(yaw_rad)), abs(np.sin(yaw_rad))
    own = [(width + depth) / 2 / (cosine + sine)] * 2
    if abs(spread := cosine**2 - sine**2) > 0.1:
        solved = (
            (cosine * width - sine * depth) / spread, (cosine * depth - sine * width) / spread
        )  # fmt: skip
        own = list(solved) if min(solved) > 0 else own
    return Turned(yaw_rad, (own[0], height, own[1]))


def _placed(shards: Path, model_id: str, model_to_room: np.ndarray) -> Mesh | None:
    if not model_id:
        return None
    model = read_model(model_path(shards, model_id))
    matrix = np.asarray(model_to_room, dtype=np.float64)
    vertices = model.vertices_m @ matrix[:3, :3].T + matrix[:3, 3]
    # A mirrored placement reverses the orientation of all triangles.
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    return Mesh(vertices, model.faces[:, ::-1] if mirrored else model.faces)


def model_path(shards: Path, model_id: str) -> Path:
    """Path of a model in a folder of shards."""
    return shards / MODELS_FOLDER / f"{model_id}.ply"


def load_model(path: Path) -> Mesh:
    """Read a model of a folder of shards (`model_path`) in its own frame."""
    if not path.is_file():
        raise ShardError(
            f"{path} is missing, but a room's ground truth refers to it. Keep `models/` beside "
            "the shards, or run `sceneprior prep-front` again."
        )
    import trimesh

    check_file(path)
    then = ". Delete it and run `sceneprior prep-front` again."
    with reading(path, " is not a triangle mesh", then, ShardError):
        model = trimesh.load_mesh(path, process=False)
        return mesh_of_file(np.asarray(model.vertices, dtype=np.float64), model.faces)


def read_model(path: Path) -> Mesh:
    """`load_model`, once for each version of a file."""
    return _read_version(path, file_stamp(path) if path.is_file() else None)


@lru_cache(maxsize=4096)
def _read_version(path: Path, stamp: tuple[int, int] | None) -> Mesh:
    return load_model(path)
