"""Paths between rooms: moves of objects, changes of shapes, and quality of the rooms in between.

    python benchmarks/interpolation.py RUN [--shards FOLDER] [--paths 100] [--steps 33] [--seed 0]

Paths lead between random pairs of training rooms (if the prior keeps their latents), and between
random points of the latent space. The first table counts jumps of objects between consecutive
steps: moves of an object's centre above three times the median of the path, or of the object's
moves. Objects that appear, disappear or change their class are counted separately. The table also
counts changes of shape (Chamfer distance of the two meshes in the room, `--shapes` paths) above
three times the object's median, both as the prior decodes each step and as `interpolate` blends
shapes. The second table evaluates rooms at five places from the start to the middle, one room of
each path per place; by symmetry, the other half of a path is no different.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from requested_rooms import accuracy
from rooms_needed import relations, scenes_of

import sceneprior
from sceneprior.core.ground_truth import known_in_3d
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.surfaces import chamfer_of, surface_points
from sceneprior.evaluation.metrics.contents import (
    intersecting,
    plausible_pairs,
    sum_over_pairs,
)
from sceneprior.paper.interpolate import RoomPath, even_places
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import DecodedRoom, decode_rooms, draw_latents

JUMP = 3.0
"""A jump is a step of more than this multiple of the median."""
PLACES = (0.0, 0.125, 0.25, 0.375, 0.5)
POINTS = 50
"""Number of points per mesh whose distances to the other mesh are averaged."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("run")
    parser.add_argument("--shards", type=Path, help="rooms to compare with, if not the run's own")
    parser.add_argument("--paths", type=int, default=100)
    parser.add_argument("--shapes", type=int, default=30, help="paths whose meshes are compared")
    parser.add_argument("--steps", type=int, default=33)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    trained, seed = sceneprior.load(arguments.run).with_latents, arguments.seed
    shards = arguments.shards or Path(trained.config.data.shards)
    real = [
        room
        for split in ("train", "val")
        if known_in_3d(shards, split)
        for room in scenes_of(shards, split)
    ]
    test = scenes_of(shards, "test")
    few = np.random.default_rng(seed).permutation(len(real))[: arguments.paths]
    for name, rooms in (("real training", [real[k] for k in few]), ("real test", test)):
        tell(rooms=name, **judged(rooms, real, test))
    for name, paths in paths_of(trained, arguments.paths, seed).items():
        tell(between=name, **changes(paths[: arguments.shapes], arguments.steps))
        paths = [replace(path, trained=replace(trained, stage="layout")) for path in paths]
        tell(between=name, **moves(paths, arguments.steps))
        at = [path.rooms(torch.tensor(PLACES), [""] * len(PLACES)) for path in paths]
        for place, decoded in zip(PLACES, zip(*at, strict=True), strict=True):
            rooms = [room.scene for room in decoded]
            classifier = accuracy(rooms, real, test, seed)
            tell(between=name, place=place, classifier=classifier, **judged(rooms, real, test))


def tell(**row: Any) -> None:
    """Print a row, with numbers rounded to three decimals."""
    print(
        json.dumps({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}),
        flush=True,
    )


def paths_of(trained: TrainedPrior, count: int, seed: int) -> dict[str, list[RoomPath]]:
    """Paths between random training rooms, if they are known, and between random latents."""
    space, rng = trained.prior.latent_space, np.random.default_rng(seed)
    anywhere = draw_latents(trained, 2 * count, seed, "paper").unflatten(0, (count, 2))
    ends = {"latents anywhere": anywhere}
    if len(trained.logits) > 1:
        pairs = [rng.choice(len(trained.logits), 2, replace=False) for _ in range(count)]
        ends = {"training rooms": space(trained.logits)[np.stack(pairs)], **ends}
    return {name: [RoomPath(trained, *pair) for pair in pairs] for name, pairs in ends.items()}


def moves(paths: Sequence[RoomPath], steps: int) -> dict[str, Any]:
    """Jumps of objects' centres per step; appearing and disappearing objects, and changes of class,
    per path."""
    of_path, of_object, moved = [], [], []
    come = gone = relabelled = 0
    for path in paths:
        rooms = path.rooms(even_places(steps), [""] * steps)
        tracks: dict[int, list[float]] = {}
        for before, after in pairwise(rooms):
            slots = set(before.predictions), set(after.predictions)
            come, gone = come + len(slots[1] - slots[0]), gone + len(slots[0] - slots[1])
            for slot in slots[0] & slots[1]:
                here, there = (item_of(room, slot) for room in (before, after))
                move = np.subtract(there.center_m, here.center_m)
                tracks.setdefault(slot, []).append(float(np.linalg.norm(move)))
                relabelled += here.label != there.label
        each = np.concatenate(list(tracks.values()))
        of_path.append(each > JUMP * np.median(each))
        of_object += [np.array(track) > JUMP * np.median(track) for track in tracks.values()]
        moved.append(each)
    return {
        "steps_of_objects": sum(map(len, moved)),
        "median_move_cm": 100 * float(np.median(np.concatenate(moved))),
        "largest_move_cm": 100 * float(np.concatenate(moved).max()),
        "jumps_of_path": float(np.concatenate(of_path).mean()),
        "jumps_of_object": float(np.concatenate(of_object).mean()),
        "appear": come / len(paths),
        "disappear": gone / len(paths),
        "class_changes": relabelled / len(paths),
    }


def changes(paths: Sequence[RoomPath], steps: int) -> dict[str, Any]:
    """Changes of shape per step, as decoded and as blended, and the distance between the two.

    `jumps` and `median_cm` are for meshes in the room, whose boxes move; `alone_99%_cm` is for
    shapes alone, with both meshes in the same box.
    """
    moved: dict[str, list[np.ndarray]] = {"decoded": [], "blended": []}
    alone: dict[str, list[float]] = {"decoded": [], "blended": []}
    apart = []
    for path in paths:
        places, names = even_places(steps), [""] * steps
        rooms = {
            "decoded": decode_rooms(path.trained, path.latents(places), names),
            "blended": path.rooms(places, names),
        }
        for name, way in rooms.items():
            tracks: dict[int, list[float]] = {}
            for before, after in pairwise(way):
                for slot in set(before.predictions) & set(after.predictions):
                    one, other = item_of(before, slot), item_of(after, slot)
                    tracks.setdefault(slot, []).append(chamfer_m(one, other))
                    here = other.in_box(one.center_m, one.size_m)
                    alone[name].append(chamfer_m(one, here))
            moved[name] += map(np.array, tracks.values())
        for decoded, blended in zip(*rooms.values(), strict=True):
            pairs = zip(decoded.scene.objects, blended.scene.objects, strict=True)
            apart += [chamfer_m(one, other) for one, other in pairs]
    told: dict[str, Any] = {}
    for name, sizes in moved.items():
        jumps = np.concatenate([size > JUMP * np.median(size) for size in sizes])
        told[f"{name}_jumps"] = float(jumps.mean())
        told[f"{name}_median_cm"] = 100 * float(np.median(np.concatenate(sizes)))
        told[f"{name}_alone_99%_cm"] = 100 * float(np.quantile(alone[name], 0.99))
    return {**told, "blended_from_decoded_cm": 100 * float(np.mean(apart))}


def item_of(room: DecodedRoom, slot: int) -> SceneObject:
    """The object of prediction `slot`."""
    return room.scene.objects[room.predictions.index(slot)]


def chamfer_m(one: SceneObject, other: SceneObject) -> float:
    """Chamfer distance (both ways added) from points of each mesh to the other's triangles, so that
    it is 0 for equal meshes."""
    a, b = one.mesh, other.mesh
    assert a is not None and b is not None, "the runs have shapes"
    if a.vertices_m.shape == b.vertices_m.shape and np.allclose(a.vertices_m, b.vertices_m):
        return 0.0
    return chamfer_of(apart_m(a, b), apart_m(b, a)).l2_m


def apart_m(a: Mesh, b: Mesh) -> np.ndarray:
    """Distances from points on mesh a to the nearest points of mesh b."""
    points = surface_points(a.vertices_m, a.faces, POINTS)
    corners = np.asarray(b.vertices_m, dtype=np.float64)[b.faces]
    nearest = trimesh.triangles.closest_point(
        np.tile(corners, (POINTS, 1, 1)), points.repeat(len(corners), axis=0)
    ).reshape(POINTS, -1, 3)
    return np.linalg.norm(nearest - points[:, None], axis=2).min(axis=1)


def judged(rooms: Sequence[Scene], real: Sequence[Scene], test: Sequence[Scene]) -> dict[str, Any]:
    """Metrics of a set of rooms (docs/evaluation.md), without intervals."""
    plausible = plausible_pairs(real)
    implausible = [sum_over_pairs(room, ~plausible, intersecting) for room in rooms]
    return {
        "implausible_pairs": float(np.mean(implausible)),
        "relations_m": relations(rooms, real, test),
        "with_bed": float(np.mean([any("bed" in i.label for i in room.objects) for room in rooms])),
        "objects": float(np.mean([len(room.objects) for room in rooms])),
    }


if __name__ == "__main__":
    main()
