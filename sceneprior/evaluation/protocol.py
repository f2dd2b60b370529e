"""Score synthesized rooms: generated `Scene`s and a folder of shards in, every figure with its
protocol out, beside the same figure for real training rooms."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import Progress

from sceneprior.classes import VOID
from sceneprior.errors import InputError
from sceneprior.evaluation.alexnet import check_alexnet
from sceneprior.evaluation.bootstrap import METHOD, RESAMPLES
from sceneprior.evaluation.features import SceneFeatures
from sceneprior.evaluation.figures import (
    Figure,
    Rooms,
    category_kl_figure,
    figures_against,
    figures_alone,
    gap_figures,
    rooms_of,
)
from sceneprior.evaluation.independent import independent_rooms
from sceneprior.evaluation.metrics.as_boxes import box_figures
from sceneprior.evaluation.metrics.image_metrics import check_inception
from sceneprior.evaluation.metrics.layout_metrics import common_label_set
from sceneprior.evaluation.metrics.novelty import nearest_distances
from sceneprior.evaluation.reference import reference_scenes
from sceneprior.evaluation.reference_file import draw_reference
from sceneprior.evaluation.stated_protocol import definitions, drawing_of, package_versions
from sceneprior.offscreen import Renderer
from sceneprior.scene import Scene

FORMAT = "sceneprior-scores"
VERSION = 2
"""1 hashed all pictures of a set as one, and knew neither intervals nor distances but Frechet's."""
COLUMN_GROUPS = {"generated": "generated", "train_rooms": "train", "independent": "independent"}
"""Which rooms stand in the columns of the result that are compared with test rooms."""
NOTE = (
    "Measured on the rooms of these shards. Where they come from `sceneprior make-homes`, they "
    "are made-up homes: no figure here can be compared with the paper's, which are on 3D-FRONT."
)


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
    boxes: bool = False,
    out: Path | None = None,
) -> dict[str, Any]:
    """Compare generated rooms with the test rooms, and real and independent rooms with them too.

    Void objects are left out everywhere, as the test rooms' are. The training rooms are as many
    as the generated ones (all of them if there are fewer), drawn without replacement by `seed`:
    a Frechet distance depends on the number of images, so only equal numbers can be compared.
    Independent rooms, see `independent_rooms`, are as many as real training rooms.

    Args:
        generated: Rooms with meshes, or boxes alone, which are drawn as boxes.
        shards: Folder of shards with ground truth; its `test` and `train` splits are read.
        inception: NVIDIA's `inception-2015-12-05.pt`; None leaves `fid` and its kin out.
        alexnet: torchvision's AlexNet weights; None leaves `sca` out.
        seed: Chooses the training rooms, the classifiers' folds and the resamples.
        resamples: Of the intervals; 0 leaves them out.
        renderer: From `sceneprior.offscreen.open_renderer`.
        reference: File that keeps what was read from the real rooms' pictures; None draws them.
        boxes: Also compare pictures of all rooms drawn as boxes: their layouts alone.
        out: JSON file to write, whole or not at all; None writes nothing.

    Returns:
        The figures of the generated rooms, `<key>_test` for those that the test rooms have by
        themselves, under `train_rooms` the figures of real training rooms, under `independent`
        those of rooms of independent objects (and what their pictures say with real meshes under
        `independent_meshes`), `intervals` by column, and under `protocol` all they depend on.
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
    drawing = drawing_of(names, renderer, inception, alexnet)
    independent = independent_rooms(every_train, len(train), seed)
    with Progress(console=Console(stderr=True)) as bars:

        def progress(group: str, count: int) -> Callable[[int], object]:
            return partial(bars.advance, bars.add_task(f"Drawing {group} rooms", total=count))

        def draw(group: str, scenes: Sequence[Scene]) -> SceneFeatures:
            return drawing.features(scenes, progress(group, len(scenes)))

        rooms = {"test": len(test), "train": len(every_train)}
        drawn = draw_reference(shards, drawing, rooms, train_rows, progress, reference)
        drawn["generated"] = draw("generated", generated)
        drawn["independent"] = draw("independent", independent)
        # The same rooms once more: meshes of all training rooms live no longer than this line.
        furnished = independent_rooms(reference_scenes(shards, "train"), len(train), seed, True)
        drawn["independent_meshes"] = draw("independent, furnished", furnished)
        del furnished
        groups = {"test": test, "generated": generated, "train": train, "independent": independent}
        as_boxes: dict[str, SceneFeatures] = {}
        if boxes:
            as_boxes["independent"] = drawn["independent"]  # which have no meshes
            for group in ("test", "generated", "train"):
                plain = [scene.without_meshes() for scene in groups[group]]
                as_boxes[group] = draw(f"boxed {group}", plain)

    own = {"train": train_rows}
    sets: dict[str, Rooms] = {}
    for number, (group, scenes) in enumerate(groups.items()):
        nearest = nearest_distances(scenes, every_train, own.get(group))
        sets[group] = rooms_of(scenes, drawn[group], nearest, resamples, (seed, number))
    # Frechet distances compare at equal numbers of rooms alone.
    fair_rows = seeded_rows(len(generated), len(train), seed)
    meshes = drawn["independent_meshes"]
    columns = _columns(sets, meshes, fair_rows, seed, inception is not None, alexnet)
    if boxes:
        layouts = box_figures(sets, as_boxes, COLUMN_GROUPS, fair_rows, (seed, len(sets)))
        columns = {name: own | layouts.get(name, {}) for name, own in columns.items()}
    scores: dict[str, Any] = {"format": FORMAT, "version": VERSION, "note": NOTE}
    scores |= {key: figure.value for key, figure in columns["generated"].items()}
    scores |= {f"{key}_test": figure.value for key, figure in columns["test"].items()}
    for column in ("train_rooms", "independent", "independent_meshes"):
        scores[column] = {key: figure.value for key, figure in columns[column].items()}
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
        "n_independent": len(independent),
        "n_gap": len(train),
        "seed": seed,
        "resamples": resamples,
        "intervals": METHOD,
        "render": drawing.render_protocol,
        "renders_sha256": {group: features.sha256 for group, features in drawn.items()},
        "networks": drawing.networks,
        **definitions(names, alexnet),
        "packages": package_versions(),
    }
    if out is not None:
        write_scores(scores, out)
    return scores


def _columns(
    sets: dict[str, Rooms],
    meshes: SceneFeatures,
    fair_rows: Sequence[int],
    seed: int,
    inception: bool,
    alexnet: Path | None,
) -> dict[str, dict[str, Figure]]:
    """The figures of every set of rooms; `meshes` are the independent rooms' with real meshes."""
    test = sets["test"]

    def pictures(rooms: Rooms) -> dict[str, Figure]:
        return figures_against(rooms, test, seed, inception, alexnet)

    columns = {"test": figures_alone(test)}
    for column, group in COLUMN_GROUPS.items():
        rooms = sets[group]
        layout = {"category_kl": category_kl_figure(rooms, test), **figures_alone(rooms)}
        columns[column] = pictures(rooms) | layout
    columns["independent_meshes"] = pictures(replace(sets["independent"], features=meshes))
    fair = sets["generated"].of(fair_rows, (seed, len(sets)))
    for column, suffix in (("independent", ""), ("independent_meshes", "_meshes")):
        gaps = gap_figures(fair, test, columns[column], columns["train_rooms"])
        columns["generated"] |= {f"{key}{suffix}": figure for key, figure in gaps.items()}
    return columns


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
