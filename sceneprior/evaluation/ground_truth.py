"""The true rooms of shards, in 3D, as `Scene`s: what others are compared with."""

import hashlib
import json
from collections.abc import Collection, Iterator
from functools import lru_cache
from itertools import islice
from pathlib import Path

import numpy as np

from sceneprior.classes import VOID, label_set
from sceneprior.errors import ShardError
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
        limit: At most this many rooms; None reads all.
        tracked_only: Leave out furniture that no camera saw: what a decoded training room
            can be held against.
        meshes: Read the models, too; without them a room is its boxes, and much smaller.

    Raises:
        ShardError: a shard, the ground truth or a model's file is missing or damaged.
    """
    rooms = islice(iterate_rooms(shards, split), limit)
    return [
        reference_scene(shard, room_id, shards, tracked_only, meshes) for shard, room_id in rooms
    ]


def stream_scenes(shards: Path, split: str, rows: Collection[int]) -> Iterator[Scene]:
    """Some rooms of `reference_scenes`, by their places there, with meshes and one at a time."""
    wanted = set(rows)
    for row, (shard, room_id) in enumerate(iterate_rooms(shards, split)):
        if row in wanted:
            yield reference_scene(shard, room_id, shards)


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
    count = len(truth.object_class)
    if tracked_only:
        count = len(shard.read_room(room_id).object_class)
    objects = tuple(
        SceneObject(
            names[int(truth.object_class[row])],
            _triple(truth.centers_m[row]),
            _triple(truth.sizes_m[row]),
            _placed(Path(shards), truth.model_ids[row], truth.model_to_room[row])
            if meshes
            else None,
        )
        for row in range(count)
        if truth.object_class[row] != VOID
    )
    return Scene(
        name=room_id,
        label_set=shard.label_set,
        objects=objects,
        floor_m=np.asarray(truth.floor_m, dtype=np.float64),
        extra={"room_id": room_id, "height_m": truth.height_m},
    )


def _triple(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def _placed(shards: Path, model_id: str, model_to_room: np.ndarray) -> Mesh | None:
    if not model_id:
        return None
    model = _load_model(shards / MODELS_FOLDER / f"{model_id}.ply")
    matrix = np.asarray(model_to_room, dtype=np.float64)
    vertices = model.vertices_m @ matrix[:3, :3].T + matrix[:3, 3]
    # A mirrored placement turns every triangle inside out.
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    return Mesh(vertices, model.faces[:, ::-1] if mirrored else model.faces)


@lru_cache(maxsize=4096)
def _load_model(path: Path) -> Mesh:
    import trimesh

    if not path.is_file():
        raise ShardError(
            f"{path} is missing, but a room's ground truth stands on it. Keep `models/` beside "
            "the shards, or run `sceneprior prep-front` again."
        )
    try:
        model = trimesh.load_mesh(path, process=False)
        return Mesh(np.asarray(model.vertices, dtype=np.float64), np.asarray(model.faces))
    except Exception as error:  # what trimesh raises depends on which byte is damaged
        raise ShardError(
            f"{path} is not a triangle mesh ({type(error).__name__}: {error}). Delete it and run "
            "`sceneprior prep-front` again."
        ) from None
