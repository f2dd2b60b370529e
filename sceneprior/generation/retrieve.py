"""Put the most similar CAD model into every box of a scene (supplement, shape retrieval).

A box whose centre is at most 1 m high is extruded to the floor. Every CAD model of the object's
class is scaled into the box, turned by 0, 90, 180 and 270 degrees, and compared with the object's
mesh; the smallest Chamfer distance wins. An object without a mesh is compared by its box.

All models and turns are compared by few points, the most promising ones by all of theirs.
"""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from sceneprior.errors import InputError
from sceneprior.generation.cad_models import CadModels, ClassModels
from sceneprior.geometry.surfaces import chamfer_mean, surface_points
from sceneprior.geometry.turns import QUARTERS, quarter_rotation
from sceneprior.scene import Mesh, Scene, SceneObject
from sceneprior.topdown import box_mesh

STANDS_M = 1.0
"""A box whose centre is at most so high stands on the floor."""
ROUNDS = ((16, 1 / 3), (4, None))
"""(step, share): comparisons by every `step`-th point, and the share of the models that goes on."""
KEEP = 16
"""Models with a turn that are compared by all points; None takes all of them: exact, and slow."""
_BLOCK = 2**16
"""Squared distances at a time: what stays in a core's cache."""


class Retrieved(NamedTuple):
    """A model in a box."""

    model_id: str
    turn_deg: int
    """The yaw of the model in the room: 0, 90, 180 or 270; docs/conventions.md."""
    distance_m: float
    """See `chamfer_mean`."""


def retrieve(scene: Scene, models: CadModels, keep: int | None = KEEP) -> Scene:
    """The scene with the mesh of the most similar CAD model in every box.

    `extra["retrieval"]` holds, in the order of the objects, {"model_id", "turn_deg", "distance_m"},
    or None where there is no model of the class: such an object keeps its own mesh, extruded with
    its box.

    Raises:
        InputError: a box or a mesh is no finite number.
    """
    _check(scene)
    objects: list[SceneObject] = []
    found: list[dict[str, object] | None] = []
    for item in scene.objects:
        box, told = extruded(item), None
        if of_class := models.by_class.get(item.label):
            best = most_similar(box, of_class, keep)
            mesh = placed(models.load(best.model_id), box, best.turn_deg)
            objects.append(replace(box, mesh=mesh))
            told = best._asdict() | {"distance_m": round(best.distance_m, 5)}
        else:
            objects.append(item if box is item else item.in_box(box.center_m, box.size_m))
        found.append(told)
    return replace(scene, objects=tuple(objects), extra={**scene.extra, "retrieval": found})


def retrieve_all(scenes: Sequence[Scene], models: CadModels) -> Iterator[Scene]:
    """`retrieve` for many scenes, on all cores, in their order."""
    # A thread a core, each with one of torch's: the products are small.
    with ThreadPoolExecutor(os.cpu_count(), initializer=torch.set_num_threads, initargs=(1,)) as p:
        yield from p.map(lambda scene: retrieve(scene, models), scenes)


def retrieval_report(scenes: Sequence[Scene], models: CadModels) -> dict[str, Any]:
    """What `retrieve` made of scenes: models and objects by class, distances, broken models."""
    pairs = [
        (item.label, found)
        for scene in scenes
        for item, found in zip(scene.objects, scene.extra["retrieval"], strict=True)
    ]
    classes = {}
    for label in sorted({label for label, _ in pairs}):
        given = [found for name, found in pairs if name == label and found]
        distances = [found["distance_m"] for found in given]
        there = models.by_class.get(label)
        classes[label] = {
            "objects": sum(name == label for name, _ in pairs),
            "models": len(there.model_ids) if there else 0,
            "models_used": len({found["model_id"] for found in given}),
            "mean_distance_m": round(float(np.mean(distances)), 5) if given else None,
        }
    return {
        "format": "sceneprior-retrieval",
        "version": 1,
        "scenes": len(scenes),
        "objects": len(pairs),
        "objects_with_a_model": sum(found is not None for _, found in pairs),
        "classes": classes,
        "classes_without_models": [label for label in classes if not classes[label]["models"]],
        "broken_models": dict(models.broken),
    }


def extruded(item: SceneObject) -> SceneObject:
    """The object with its box's lower face on the floor if its centre is at most 1 m high."""
    (x, y, z), (width, height, depth) = item.center_m, item.size_m
    top = y + height / 2
    if y > STANDS_M or top <= 0:
        return item
    return replace(item, center_m=(x, top / 2, z), size_m=(width, top, depth))


def placed(unit: Mesh, item: SceneObject, turn_deg: int) -> Mesh:
    """A mesh that fills [-0.5, 0.5]^3, turned and scaled into an object's box."""
    turned = unit.vertices_m @ quarter_rotation(turn_deg // 90).T
    return Mesh(turned * np.asarray(item.size_m) + np.asarray(item.center_m), unit.faces)


def most_similar(item: SceneObject, models: ClassModels, keep: int | None = KEEP) -> Retrieved:
    """The model of a class, and its turn, nearest to an object by Chamfer distance."""
    count = models.points.shape[1]
    views = _turned_views(_points_of(item, count) - np.asarray(item.center_m), item.size_m)
    choices = np.arange(len(models.model_ids) * QUARTERS)
    for step, share in ROUNDS if keep is not None else ():
        going_on = max(keep or 0, int(len(choices) * share) if share else 0)
        if going_on < len(choices):
            rough = _rough_distances(views, models.points, choices, step)
            # Stable: of equals the first model wins, whatever the machine.
            choices = choices[np.argsort(rough, kind="stable")[:going_on]]
    trees = [cKDTree(points) for points, _ in views]
    distances = []
    for choice in choices:
        model, turn = divmod(int(choice), QUARTERS)
        points, size = views[turn]
        distances.append(chamfer_mean(points, models.points[model] * size, trees[turn]))
    best = int(np.argmin(distances))
    model, turn = divmod(int(choices[best]), QUARTERS)
    return Retrieved(models.model_ids[model], 90 * turn, distances[best])


def _points_of(item: SceneObject, count: int) -> np.ndarray:
    for mesh in (item.mesh, box_mesh(item.center_m, item.size_m)):
        try:
            if mesh is not None:
                return surface_points(mesh.vertices_m, mesh.faces, count)
        except ValueError:  # no area: a mesh that collapsed, then a box without sides
            continue
    return np.tile(np.asarray(item.center_m, dtype=np.float64), (count, 1))


def _turned_views(
    points: Float[np.ndarray, "points 3"], size_m: Sequence[float]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """What each turn of the models looks like to models that stand still: the object turned back,
    and the box's sides as they then lie. Distances are the same, and models stay as stored."""
    back = [quarter_rotation(quarters).T for quarters in range(QUARTERS)]
    return [(points @ turn.T, np.abs(turn @ np.asarray(size_m, dtype=np.float64))) for turn in back]


def _rough_distances(
    views: list[tuple[np.ndarray, np.ndarray]],
    models: Float[np.ndarray, "models points 3"],
    choices: Int[np.ndarray, " choices"],
    step: int,
) -> Float[np.ndarray, " choices"]:
    """`chamfer_mean` by every `step`-th point: which models are worth a closer comparison."""
    rough = np.empty(len(choices), dtype=np.float32)
    few = models[:, ::step]
    for turn, (points, size) in enumerate(views):
        ours = torch.from_numpy(points[::step].astype(np.float32))
        # |a - b|^2 as one product: [b, 1, |b|^2] . [-2a, |a|^2, 1].
        right = torch.cat([-2 * ours, _squares(ours), torch.ones(len(ours), 1)], dim=1).T
        rows = np.flatnonzero(choices % QUARTERS == turn)
        at_once = max(1, _BLOCK // right.shape[1] ** 2)
        for start in range(0, len(rows), at_once):
            part = rows[start : start + at_once]
            theirs = torch.from_numpy(few[choices[part] // QUARTERS] * size.astype(np.float32))
            left = torch.cat([theirs, torch.ones(*theirs.shape[:2], 1), _squares(theirs)], dim=2)
            squared = left @ right
            there, back = (squared.amin(dim=dim).clamp(min=0).sqrt().mean(dim=1) for dim in (1, 2))
            rough[part] = ((there + back) / 2).numpy()
    return rough


def _squares(points: Tensor) -> Tensor:
    return points.square().sum(dim=-1, keepdim=True)


def _check(scene: Scene) -> None:
    for row, item in enumerate(scene.objects):
        numbers = np.asarray([*item.center_m, *item.size_m], dtype=np.float64)
        if not np.isfinite(numbers).all() or (numbers[3:] < 0).any():
            raise InputError(
                f"{scene.name}: the box of object {row} ({item.label}) is {numbers.tolist()}; "
                "expected a finite centre and sides that are not negative."
            )
        if item.mesh is not None and not np.isfinite(item.mesh.vertices_m).all():
            raise InputError(
                f"{scene.name}: the mesh of object {row} ({item.label}) has vertices that are no "
                "numbers; write the scene again, or delete its GLB to use the boxes alone."
            )
