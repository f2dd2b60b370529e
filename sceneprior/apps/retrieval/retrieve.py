"""Replace every object of a scene by the most similar CAD model (supplement, shape retrieval).

A box whose centre is at most 1 m high is extruded to the floor. Every CAD model of the object's
class is scaled into the box, turned by 0, 90, 180 and 270 degrees, and compared with the object's
mesh; the model with the smallest Chamfer distance is taken. If the object's yaw is known, models
have it. An object without a mesh is compared by its box.

All models and turns are first compared by few points, and the best candidates by all points.
"""

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from sceneprior.apps.retrieval.cad_models import CadModels, ClassModels, made_models
from sceneprior.apps.sample import Then
from sceneprior.core.boxes import QUARTERS, quarter_rotation
from sceneprior.core.parallel import map_blocks
from sceneprior.core.repeatable import single_threaded
from sceneprior.core.scene import Mesh, Scene, SceneObject, quarter_turned
from sceneprior.core.surfaces import chamfer_of, nearest_distances, surface_points
from sceneprior.render.appearance import box_mesh
from sceneprior.render.silhouettes.cpu.kernels import thread_count

STANDS_M = 1.0
"""Largest height of a box's centre for which the box is extruded to the floor."""
ROUNDS = ((16, 1 / 3), (4, None))
"""(step, share) of each preselection: compare every `step`-th point, and keep this share of the
candidates; None keeps `KEEP`."""
KEEP = 16
"""Candidates (model and turn) compared by all points."""
ALIKE = 1.3
"""Largest ratio of the extents of two objects of a class that get the same model, if asked for."""
BLOCK = 32
"""Rooms of a task."""
_BLOCK = 2**16
"""Number of squared distances computed at a time, to fit in a core's cache."""


class Retrieved(NamedTuple):
    """The model retrieved for a box."""

    model_id: str
    turn_deg: int
    """The yaw of the model in the room: 0, 90, 180 or 270 (docs/conventions.md)."""
    distance_m: float
    """Chamfer distance between the object and the model in metres, the mean of both directions."""


def retrieve(
    scene: Scene, models: CadModels, keep: Collection[int] = (), alike: bool = False
) -> Scene:
    """Replace every object's mesh and materials by those of the most similar CAD model.

    A model has the object's yaw if it is known and a quarter turn; otherwise its turn becomes the
    object's yaw (`SceneObject.turned`). `extra["retrieval"]` holds {"model_id", "turn_deg",
    "distance_m"} for each object, in the order of the objects. The entry is None for a class
    without models; such an object keeps its mesh, extruded together with its box.

    Args:
        keep: Indices of objects that stay as they are, with the entries that they have.
        alike: Objects of a class whose sizes are similar (`ALIKE`) get the model of the first of
            them, so that two nightstands, or the chairs of a table, are of one kind.
    """
    objects: list[SceneObject] = []
    found: list[dict[str, Any] | None] = []
    before = scene.extra.get("retrieval")
    if not isinstance(before, list) or len(before) != len(scene.objects):
        before = [None] * len(scene.objects)
    for row, item in enumerate(scene.objects):
        box, told = item if row in keep else extruded(item), None
        if row not in keep and (of_class := models.of_class(item.label)):
            twins = zip(objects, found, strict=True) if alike else ()
            ids = [told["model_id"] for item, told in twins if told and _are_alike(item, box)]
            best = most_similar(box, of_class.only(ids[0]) if ids else of_class)
            mesh = placed(models.load(best.model_id), box, best.turn_deg)
            textured = tuple(
                part._replace(mesh=placed(part.mesh, box, best.turn_deg))
                for part in models.textured(best.model_id)
            )
            turned = quarter_turned(box.size_m, best.turn_deg // 90)
            objects.append(replace(box, mesh=mesh, turned=turned, solids=(), textured=textured))
            told = best._asdict() | {"distance_m": round(best.distance_m, 5)}
        else:
            if box is not item:
                item = replace(item.in_box(box.center_m, box.size_m), turned=box.turned)
            objects.append(item)
            told = before[row] if row in keep else None
        found.append(told)
    return replace(scene, objects=tuple(objects), extra={**scene.extra, "retrieval": found})


def _are_alike(first: SceneObject, second: SceneObject) -> bool:
    sizes_m = first.size_m, second.size_m
    if first.turned and second.turned:
        sizes_m = first.turned.size_m, second.turned.size_m
    ratios = np.divide(*np.maximum(sizes_m, 1e-9))
    return first.label == second.label and bool(np.abs(np.log(ratios)).max() <= np.log(ALIKE))


def retrieve_all(
    scenes: Sequence[Scene], models: CadModels, then: Then | None = None
) -> list[Scene]:
    """Apply `retrieve` to many scenes, and `then` as in `Prior.sample`, in tasks of `BLOCK`."""
    some = partial(_retrieve_some, partial(retrieve, models=models), then)
    return map_blocks(some, scenes, BLOCK, "choosing models")


def _retrieve_some(
    one: Callable[[Scene], Scene], then: Then | None, scenes: Sequence[Scene], first: int
) -> list[Scene]:
    with single_threaded(), ThreadPoolExecutor(thread_count()) as pool:
        found = [*pool.map(one, scenes)]
    return found if then is None else then(found, first)


def with_models(scenes: Sequence[Scene], given: Sequence[SceneObject] = ()) -> list[Scene]:
    """Scenes with the package's own models, alike where sizes are, in place of their meshes.

    Args:
        given: Objects given by the user, which come first in every scene; those with a mesh keep
            it.
    """
    keep = [row for row, item in enumerate(given) if item.mesh is not None]
    one = partial(retrieve, models=made_models(), keep=keep, alike=True)
    return _retrieve_some(one, None, scenes, 0)


def retrieval_report(scenes: Sequence[Scene], models: CadModels) -> dict[str, Any]:
    """Report on retrieved scenes: models and objects by class, distances, broken models."""
    pairs = [
        (item.label, found)
        for scene in scenes
        for item, found in zip(scene.objects, scene.extra["retrieval"], strict=True)
    ]
    classes = {}
    for label in sorted({label for label, _ in pairs}):
        given = [found for name, found in pairs if name == label and found]
        distances = [found["distance_m"] for found in given]
        there = models.of_class(label)
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
    turned = item.turned
    if turned is not None:
        turned = turned._replace(size_m=(turned.size_m[0], top, turned.size_m[2]))
    return replace(item, center_m=(x, top / 2, z), size_m=(width, top, depth), turned=turned)


def placed(unit: Mesh, item: SceneObject, turn_deg: int) -> Mesh:
    """A mesh that fills [-0.5, 0.5]^3, turned and scaled into an object's box."""
    turned = unit.vertices_m @ quarter_rotation(turn_deg // 90).T
    return Mesh(turned * np.asarray(item.size_m) + np.asarray(item.center_m), unit.faces)


def most_similar(item: SceneObject, models: ClassModels) -> Retrieved:
    """The model and turn of a class that are nearest to an object by Chamfer distance.

    If the object's yaw is known and a quarter turn, models at other turns are left out: a cupboard
    that faces backwards is nearly as near as one that faces forwards.
    """
    # Turning the object back by each quarter turn, instead of turning the models, gives the same
    # distances, and the models' points are used as stored.
    at_center = _points_of(item, models.points.shape[1]) - np.asarray(item.center_m)
    back = [quarter_rotation(quarters).T for quarters in range(QUARTERS)]
    size_m = np.asarray(item.size_m, dtype=np.float64)
    views = [(at_center @ turn.T, np.abs(turn @ size_m)) for turn in back]
    choices = np.arange(len(models.model_ids) * QUARTERS)
    if (known := _known_turn(item)) is not None:
        choices = choices[choices % QUARTERS == known]
    for step, share in ROUNDS:
        going_on = max(KEEP, int(len(choices) * share) if share else 0)
        if going_on < len(choices):
            rough = _rough_distances(views, models.points, choices, step)
            # A stable sort keeps the first of equal models on every machine.
            choices = choices[np.argsort(rough, kind="stable")[:going_on]]
    trees = {turn: cKDTree(views[turn][0]) for turn in np.unique(choices % QUARTERS)}
    distances = []
    for choice in choices:
        model, turn = divmod(int(choice), QUARTERS)
        points, size = views[turn]
        apart = nearest_distances(points, models.points[model] * size, trees[turn])
        distances.append(chamfer_of(*apart).l2_m / 2)
    best = int(np.argmin(distances))
    model, turn = divmod(int(choices[best]), QUARTERS)
    return Retrieved(models.model_ids[model], 90 * turn, distances[best])


def _known_turn(item: SceneObject) -> int | None:
    """An object's yaw in quarter turns; None if it is unknown or no quarter turn."""
    if item.turned is None:
        return None
    quarters = item.turned.yaw_rad / (np.pi / 2)
    return round(quarters) % QUARTERS if abs(quarters - round(quarters)) < 1e-3 else None


def _points_of(item: SceneObject, count: int) -> np.ndarray:
    for mesh in (item.mesh, box_mesh(item.center_m, item.size_m)):
        try:
            if mesh is not None:
                return surface_points(mesh.vertices_m, mesh.faces, count)
        except ValueError:  # no area: a collapsed mesh, or a box of size 0
            continue
    return np.tile(np.asarray(item.center_m, dtype=np.float64), (count, 1))


def _rough_distances(
    views: list[tuple[np.ndarray, np.ndarray]],
    models: Float[np.ndarray, "models points 3"],
    choices: Int[np.ndarray, " choices"],
    step: int,
) -> Float[np.ndarray, " choices"]:
    """The distance over every `step`-th point, for preselection."""
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
