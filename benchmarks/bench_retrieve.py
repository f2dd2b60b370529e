"""Time and accuracy of CAD retrieval: 1,000 scenes of 6 objects against 5,000 models.

    python benchmarks/bench_retrieve.py [--scenes 1000] [--models 5000] [--checked 40] [--json FILE]

The data are made in memory by --seed. Models are furniture-like unions of two to seven blocks;
objects are spheres of 2,562 vertices wrapped around other such unions, similar to the shape
decoder's meshes. The classes of models and objects are distributed like those of 3D-FUTURE (by the
table that the package ships), so that large classes have most queries. Only the search is timed,
from meshes to meshes: `retrieve_all`, with one thread per core. For --checked objects, the result
is compared with an exhaustive search over all models by all points.
"""

import argparse
import json
import os
import time
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from sceneprior.apps.retrieval.cad_models import POINTS, CadModels, ClassModels, unit_mesh
from sceneprior.apps.retrieval.retrieve import extruded, most_similar, retrieve_all
from sceneprior.core.boxes import BOX_FACES, CUBE_CORNERS
from sceneprior.core.furniture import category_table
from sceneprior.core.meshes import icosphere
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.surfaces import surface_points

OBJECTS = 6
LABEL_SET = "front3d_bedroom"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", type=int, default=1000)
    parser.add_argument("--models", type=int, default=5000)
    parser.add_argument("--checked", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    shares = class_shares()
    start = time.perf_counter()
    cad_models = make_bank(arguments.models, shares, rng)
    made = time.perf_counter() - start
    scenes = [make_scene(f"scene_{k:04d}", shares, rng) for k in range(arguments.scenes)]
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in retrieve_all(scenes, cad_models):
        pass
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    objects = arguments.scenes * OBJECTS
    measured = {
        "scenes": arguments.scenes,
        "objects": objects,
        "models": arguments.models,
        "largest_class": max(len(some.model_ids) for some in cad_models.by_class.values()),
        "points": POINTS,
        "cores": os.cpu_count(),
        "bank_s": round(made, 1),
        "wall_s": round(wall, 1),
        "cpu_s": round(cpu, 1),
        "cpu_ms_per_object": round(1000 * cpu / objects, 1),
        **check(scenes, cad_models, arguments.checked),
    }
    print(json.dumps(measured, indent=1))
    if arguments.json:
        arguments.json.write_text(json.dumps(measured, indent=1) + "\n")


def class_shares() -> dict[str, float]:
    """Shares of 3D-FUTURE's models in the classes of bedrooms."""
    counts: dict[str, int] = {}
    for row in category_table().values():
        if row["bedroom_class"] != "void":
            label = row["bedroom_class"]
            counts[label] = counts.get(label, 0) + int(row["models_in_3d_future"])
    total = sum(counts.values())
    return {label: count / total for label, count in counts.items()}


def make_bank(models: int, shares: dict[str, float], rng: np.random.Generator) -> CadModels:
    labels = rng.choice(list(shares), models, p=list(shares.values()))
    meshes = {f"model_{k:05d}": piece(rng) for k in range(models)}
    points = np.stack(
        [surface_points(mesh.vertices_m, mesh.faces, POINTS) for mesh in meshes.values()]
    ).astype(np.float32)
    names = np.array(list(meshes))
    by_class = {
        label: ClassModels(tuple(names[labels == label]), points[labels == label])
        for label in sorted(set(labels))
    }
    return CadModels(by_class, meshes.__getitem__)


def piece(rng: np.random.Generator) -> Mesh:
    """A union of two to seven blocks that fills the unit box."""
    count = rng.integers(2, 8)
    middles, sides = rng.uniform(-0.5, 0.5, (count, 1, 3)), rng.uniform(0.05, 1.0, (count, 1, 3))
    vertices = (middles + sides * CUBE_CORNERS / 2).reshape(-1, 3)
    faces = (BOX_FACES + 8 * np.arange(count)[:, None, None]).reshape(-1, 3)
    return unit_mesh(Mesh(vertices, faces))


def make_scene(name: str, shares: dict[str, float], rng: np.random.Generator) -> Scene:
    vertices, faces = (part.numpy() for part in icosphere(4))
    cube = vertices / np.abs(vertices).max(axis=1, keepdims=True) / 2
    objects = []
    for label in rng.choice(list(shares), OBJECTS, p=list(shares.values())):
        like = piece(rng)
        surface = surface_points(like.vertices_m, like.faces, 2048)
        near = 0.8 * surface[cKDTree(surface).query(cube)[1]] + 0.2 * cube
        size = rng.uniform(0.4, 2.2, 3)
        center = np.array([rng.uniform(-2, 2), size[1] / 2, rng.uniform(-2, 2)])
        mesh = Mesh(near * size + center, faces)
        objects.append(SceneObject(str(label), tuple(center.tolist()), tuple(size.tolist()), mesh))
    return Scene(name, LABEL_SET, tuple(objects))


def check(scenes: list[Scene], cad_models: CadModels, count: int) -> dict[str, float]:
    """Agreement of the fast search with the exhaustive one, and its largest excess distance."""
    items = [extruded(item) for scene in scenes for item in scene.objects][:count]
    pairs = []
    for item in items:
        some = cad_models.by_class[item.label]
        pairs.append((most_similar(item, some), most_similar(item, some, keep=None)))
    return {
        "checked": len(pairs),
        "same_winner": sum(fast == slow for fast, slow in pairs),
        "worst_excess_mm": round(
            1000 * max((fast.distance_m - slow.distance_m for fast, slow in pairs), default=0), 3
        ),
    }


if __name__ == "__main__":
    main()
