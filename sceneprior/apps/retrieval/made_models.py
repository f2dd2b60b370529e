"""The package's own procedural furniture (`sceneprior/furniture`), as CAD models by class.

Nothing is stored: a class is built when an object first needs it, in 10 to 100 ms.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import cache

import numpy as np

from sceneprior.apps.retrieval.cad_models import POINTS, SEED, CadModels, ClassModels, unit_points
from sceneprior.apps.retrieval.retrieve import retrieve_all
from sceneprior.core.geometry.surfaces import surface_points
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.furniture.catalog import Model, furniture_classes, make_variants


def with_models(scenes: Sequence[Scene], given: Sequence[SceneObject] = ()) -> list[Scene]:
    """Scenes with the package's own models in place of their meshes (`retrieve`).

    Args:
        given: Objects given by the user, which come first in every scene;
            those with a mesh keep it.
    """
    keep = [row for row, item in enumerate(given) if item.mesh is not None]
    return list(retrieve_all(scenes, made_models(), keep))


@cache
def made_models() -> CadModels:
    """The package's own models of all classes that have tables of parts.

    A class has the models of `make_variants`, in its styles and in sizes of real furniture. Their
    meshes are unions of closed solids.
    """
    return CadModels(_Made(), _load)


class _Made(Mapping[str, ClassModels]):
    """Models by class, each class built when it is first read."""

    def __getitem__(self, label: str) -> ClassModels:
        if label not in furniture_classes():
            raise KeyError(label)
        return _models_of(label)

    def __iter__(self) -> Iterator[str]:
        return iter(furniture_classes())

    def __len__(self) -> int:
        return len(furniture_classes())


@cache
def _models_of(label: str) -> ClassModels:
    points = []
    for model in _variants(label):
        vertices, faces = _arrays(model)
        points.append(unit_points(surface_points(vertices, faces, POINTS, SEED), vertices))
    ids = tuple(f"{label}_{row:02d}" for row in range(len(points)))
    return ClassModels(ids, np.stack(points).astype(np.float32))


@cache
def _load(model_id: str) -> Mesh:
    label, _, row = model_id.rpartition("_")
    vertices, faces = _arrays(_variants(label)[int(row)])
    return Mesh(unit_points(vertices, vertices), faces)


@cache
def _variants(label: str) -> list[Model]:
    return make_variants(SEED, label)


def _arrays(model: Model) -> tuple[np.ndarray, np.ndarray]:
    return np.asarray(model.mesh.vertices), np.asarray(model.mesh.faces)
