"""The true rooms of shards as `Scene`s, and independent ones: what others are compared with."""

import hashlib
import json
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np

from sceneprior.classes import VOID, label_set
from sceneprior.errors import InputError, ShardError
from sceneprior.scene import Mesh, Scene, SceneObject
from sceneprior.shards import MODELS_FOLDER, Shard, iterate_rooms


def reference_scenes(
    shards: Path,
    split: str,
    limit: int | None = None,
    tracked_only: bool = False,
    meshes: bool = True,
) -> list[Scene]:
    """The rooms of a split in 3D, in the shards' own order.

    Args:
        shards: Folder of view shards with ground truth; meshes lie in its `models/`.
        tracked_only: Leave out furniture that no camera saw: what a decoded training room
            can be held against.
        meshes: Read the models, too; without them a room is its boxes, and much smaller.

    Raises:
        ShardError: a shard, the ground truth or a model's file is missing or damaged.
    """
    return [
        reference_scene(*room, shards, tracked_only, meshes)
        for room in islice(iterate_rooms(shards, split), limit)
    ]


def known_in_3d(shards: Path, split: str) -> bool:
    """Whether a split has rooms, each with a ground truth; rooms of posed pictures have none."""
    return any((Path(shards) / split).glob("*.h5")) and all(
        shard.has_ground_truth(room_id) for shard, room_id in iterate_rooms(shards, split)
    )


def stream_scenes(shards: Path, split: str, rows: Collection[int]) -> Iterator[Scene]:
    """Some rooms of `reference_scenes`, by their places there, with meshes and one at a time."""
    for row, room in enumerate(iterate_rooms(shards, split)):
        if row in rows:
            yield reference_scene(*room, shards)


def independent_rooms(
    real: Sequence[Scene], count: int, seed: int, with_meshes: bool = False
) -> list[Scene]:
    """Draw rooms from the marginals of real ones: how many objects, and each object by itself.

    The number of objects is that of a real room drawn at random; each object is one of all
    the objects of all the rooms, drawn at random with its class and where it stands. Single objects
    are therefore perfectly real, and only what holds a room together is missing.

    `with_meshes` keeps the real meshes, which makes it harder to beat; else objects are boxes.

    Raises:
        InputError: no real room holds an object.
    """
    pool = [item for scene in real for item in scene.objects]
    if not pool:
        raise InputError(
            "Independent rooms are drawn from the objects of real rooms, but none of the "
            f"{len(real)} rooms given holds any; give the training rooms of prepared shards."
        )
    generator = np.random.default_rng(seed)
    sizes = generator.choice([len(scene.objects) for scene in real], size=count)
    rooms = [
        Scene(
            f"independent_{index:04d}",
            real[0].label_set,
            tuple(pool[pick] for pick in generator.integers(len(pool), size=size)),
        )
        for index, size in enumerate(sizes)
    ]
    return rooms if with_meshes else [room.without_meshes() for room in rooms]


def shuffled_rooms(real: Sequence[Scene], count: int, seed: int) -> list[Scene]:
    """Right furniture at other rooms' places, as boxes: real rooms, each object of which stands
    where an object drawn at random from all of them does (its own height, the other's x and z).

    What a room holds is real, so only what relates its objects to each other is missing.

    Args:
        real: Rooms that hold an object at least, all in all.
        count: How many; at most as many as there are real ones, drawn without replacement.
    """
    generator = np.random.default_rng(seed)
    places = [item.center_m for scene in real for item in scene.objects]
    rooms: list[Scene] = []
    for row in generator.permutation(len(real))[:count]:
        chosen = generator.integers(len(places), size=len(real[row].objects))
        objects = tuple(
            replace(item, center_m=(places[pick][0], item.center_m[1], places[pick][2]), mesh=None)
            for item, pick in zip(real[row].objects, chosen, strict=True)
        )
        rooms.append(Scene(f"shuffled_{len(rooms):04d}", real[row].label_set, objects))
    return rooms


def split_fingerprint(shards: Path, split: str) -> str:
    """SHA-256 over all that pictures of a split's rooms depend on: ids, pieces, model files."""
    digest = hashlib.sha256()
    models: set[str] = set()
    for shard, room_id in iterate_rooms(shards, split):
        truth = shard.read_ground_truth(room_id)
        digest.update(json.dumps([shard.label_set, room_id, truth.model_ids]).encode())
        for array in (truth.object_class, truth.centers_m, truth.sizes_m, truth.model_to_room):
            digest.update(np.ascontiguousarray(array).tobytes())
        models.update(model_id for model_id in truth.model_ids if model_id)
    for model_id in sorted(models):
        path = Path(shards) / MODELS_FOLDER / f"{model_id}.ply"
        digest.update(hashlib.sha256(path.read_bytes() if path.is_file() else b"").digest())
    return digest.hexdigest()


def reference_scene(
    shard: Shard, room_id: str, shards: Path, tracked_only: bool = False, meshes: bool = True
) -> Scene:
    """One room of an open shard, see `reference_scenes`; void furniture is left out."""
    truth = shard.read_ground_truth(room_id)
    names = label_set(shard.label_set)
    count = len((shard.read_room(room_id) if tracked_only else truth).object_class)
    objects = []
    for row in np.flatnonzero(truth.object_class[:count] != VOID):
        mesh = None
        if meshes:
            mesh = _placed(Path(shards), truth.model_ids[row], truth.model_to_room[row])
        label = names[int(truth.object_class[row])]
        box = _triple(truth.centers_m[row]), _triple(truth.sizes_m[row])
        objects.append(SceneObject(label, *box, mesh))
    floor = np.asarray(truth.floor_m, dtype=np.float64)
    extra = {"room_id": room_id, "height_m": truth.height_m}
    return Scene(room_id, shard.label_set, tuple(objects), floor, extra)


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def _placed(shards: Path, model_id: str, model_to_room: np.ndarray) -> Mesh | None:
    if not model_id:
        return None
    model = read_model(model_path(shards, model_id))
    matrix = np.asarray(model_to_room, dtype=np.float64)
    vertices = model.vertices_m @ matrix[:3, :3].T + matrix[:3, 3]
    # A mirrored placement turns every triangle inside out.
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    return Mesh(vertices, model.faces[:, ::-1] if mirrored else model.faces)


def model_path(shards: Path, model_id: str) -> Path:
    """Where a folder of shards keeps a model."""
    return shards / MODELS_FOLDER / f"{model_id}.ply"


@lru_cache(maxsize=4096)
def read_model(path: Path) -> Mesh:
    """A model of shards (`model_path`) in its own frame.

    Raises:
        ShardError: it is missing or damaged.
    """
    if not path.is_file():
        raise ShardError(
            f"{path} is missing, but a room's ground truth stands on it. Keep `models/` beside "
            "the shards, or run `sceneprior prep-front` again."
        )
    import trimesh

    try:
        model = trimesh.load_mesh(path, process=False)
        return Mesh(np.asarray(model.vertices, dtype=np.float64), np.asarray(model.faces))
    except Exception as error:  # what trimesh raises depends on which byte is damaged
        raise ShardError(
            f"{path} is not a triangle mesh ({type(error).__name__}: {error}). Delete it and run "
            "`sceneprior prep-front` again."
        ) from None
