"""Evaluate a run, or a folder of the user's scenes, and write the report page of a run."""

import csv
import json
from pathlib import Path
from typing import Any

import torch

from sceneprior.config import load_any_run, run_config
from sceneprior.errors import InputError
from sceneprior.evaluation.ground_truth import known_in_3d, reference_scenes
from sceneprior.evaluation.metrics.decoded_rooms import reconstruction_scores
from sceneprior.evaluation.report import write_report
from sceneprior.evaluation.room_sets import seeded_rows
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.experiments.evaluate_views import (
    evaluate_from_views,
    known_from_views_alone,
    mask_scores,
)
from sceneprior.files import write_json
from sceneprior.generation.decode import decode_latents, decode_training_rooms, synthesize
from sceneprior.generation.sample import MARKS
from sceneprior.offscreen import open_renderer
from sceneprior.scene import Scene
from sceneprior.scene_files import load_scene_folder
from sceneprior.training.method import Trained, TrainedPrior, TrainedSampler

UNFOLDING_STEPS = 7
CURVES = (
    "loss", "class", "box", "completeness", "frustum", "mask", "mask_iou",
    "discriminator", "objects", "existence", "position", "size", "kl",
)  # fmt: skip


def evaluate_run(
    run: Path | str,
    count: int,
    options: EvalOptions,
    out: Path,
    shards: Path | None = None,
    distribution: str | None = None,
    checkpoint: str = "final",
) -> dict[str, Any]:
    """Score generated rooms against test rooms, and write the scores.

    In runs that remember their training rooms, those are decoded and scored against the truth, too;
    against masks, where rooms are known from views alone.

    The options' seed draws the latents, too; `shards` and `distribution` are by default the run's.

    Raises:
        InputError: the run, the shards or a file of weights cannot be used.
    """
    trained = load_any_run(run, checkpoint)
    folder = shards or Path(trained.config.data.shards)
    if known_from_views_alone(folder, options.split):
        masks: dict[str, float] = {}
        if isinstance(trained, TrainedPrior) and trained.remembers_rooms:
            masks = mask_scores(trained, folder)
        generated = synthesize(trained, count, options.seed, distribution)
        scores = evaluate_from_views(generated, folder, options) | masks
    else:
        # First, because other shards than the run's are refused here.
        pairs = decoded_and_true(trained, folder) if trained.remembers_rooms else []
        generated = synthesize(trained, count, options.seed, distribution)
        scores = evaluate_synthesis(generated, folder, options, [decoded for decoded, _ in pairs])
        if pairs:
            scores |= reconstruction_scores(pairs)
    scores["protocol"] |= {
        "run": Path(run).name, "stage": trained.stage, "checkpoint": checkpoint
    }  # fmt: skip
    latents = "its own"
    if isinstance(trained, TrainedPrior):
        drawn = distribution or trained.distribution
        latents = f"{drawn}, {MARKS[drawn]}" if drawn in MARKS else drawn
    scores["protocol"]["latents"] = latents
    write_json(out, scores)
    return scores


def evaluate_folder(
    folder: Path, count: int | None, options: EvalOptions, out: Path, shards: Path
) -> dict[str, Any]:
    """Score the user's scenes, of any method, against test rooms, and write the scores.

    Args:
        folder: Scene JSONs (docs/conventions.md), perhaps with the GLBs of their meshes.
        count: At most so many of them, drawn by the options' seed; None takes all.

    Raises:
        InputError: the scenes, the shards or a file of weights cannot be used.
    """
    scenes = load_scene_folder(folder)
    rows = seeded_rows(len(scenes), count or len(scenes), options.seed)
    chosen = [scenes[row] for row in rows]
    alone = known_from_views_alone(shards, options.split)
    scores = (evaluate_from_views if alone else evaluate_synthesis)(chosen, shards, options)
    scores["protocol"] |= {"scenes": folder.resolve().name, "n_scenes_available": len(scenes)}
    write_json(out, scores)
    return scores


def decoded_and_true(
    trained: Trained, shards: Path, meshes: bool = False
) -> list[tuple[Scene, Scene]]:
    """Training rooms as decoded, each with what training never saw: the room in 3D.

    Only tracked objects count: what no camera saw cannot be known. Turned copies of a room
    are left out. `meshes` are for pictures; scores of boxes need none of the true ones.
    """
    real = reference_scenes(shards, "train", tracked_only=True, meshes=meshes)
    truth = {scene.name: scene for scene in real}
    decoded = {scene.name: scene for scene in decode_training_rooms(trained)}
    missing = sorted(set(decoded) - set(truth) - {name for name in decoded if "@" in name})
    if missing:
        raise InputError(
            f"{shards} does not hold training room {missing[0]} of this run "
            f"({len(missing)} are missing); give the shards it was trained on with --shards."
        )
    return [(decoded[name], truth[name]) for name in truth if name in decoded]


def report_run(
    run: Path,
    scores: Path,
    out: Path,
    seed: int,
    commands: tuple[str, ...],
    renderer: str,
    checkpoint: str = "final",
) -> None:
    """Write the page of a run; of rooms not known in 3D, without what compares with true rooms.

    Raises:
        InputError: the run or its scores cannot be read.
    """
    trained = load_any_run(run, checkpoint)
    shards = Path(trained.config.data.shards)
    # Without true test rooms eval-fid can write no scores, and the page does without.
    needed = known_in_3d(shards, "test")
    try:
        found = json.loads(scores.read_text()) if needed or scores.exists() else {}
    except (OSError, ValueError) as error:
        raise InputError(
            f"{scores} holds no scores ({error}); write them with "
            f"`sceneprior eval-fid --run {run}`."
        ) from None
    decoded: list[tuple[Scene, Scene]] = []
    unfolding: list[Scene] = []
    if isinstance(trained, TrainedPrior) and trained.remembers_rooms:
        if known_in_3d(shards, "train"):
            decoded = decoded_and_true(trained, shards, meshes=True)
        unfolding = unfold(trained)
    from_boxes = isinstance(trained, TrainedSampler)
    write_report(
        out,
        title=f"New rooms from a prior learnt from {'boxes in 3D' if from_boxes else 'masks'}",
        shards=shards,
        run=run,
        generated=synthesize(trained, 8, seed),
        scores=found,
        commands=commands,
        curves=read_curves(run),
        decoded=decoded,
        unfolding=unfolding,
        renderer=open_renderer(renderer),
        from_boxes=from_boxes,
    )


def unfold(trained: TrainedPrior) -> list[Scene]:
    """Rooms between two training rooms that lie far apart: on the sphere, along the geodesic."""
    space = trained.prior.latent_space
    z = space(trained.logits)
    end = int(space.nearness(z[:1], z).argmin())
    start, far = z[:1].expand(UNFOLDING_STEPS, -1), z[end].expand(UNFOLDING_STEPS, -1)
    names = [f"step_{step}" for step in range(UNFOLDING_STEPS)]
    along = torch.linspace(0, 1, UNFOLDING_STEPS)
    return decode_latents(trained, space.between(start, far, along), names)


def read_curves(run: Path) -> dict[str, list[tuple[int, float]]]:
    """Loss curves of every stage from its metrics.csv, as `stage/term` -> (epoch, value)."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for stage in run_config(run).stage_names:
        path = run / stage / "metrics.csv"
        if not path.is_file():
            continue
        with path.open(newline="") as file:
            for row in csv.DictReader(file):
                for term in CURVES:
                    if row.get(f"train/{term}"):
                        point = (int(row["epoch"]), float(row[f"train/{term}"]))
                        curves.setdefault(f"{stage}/{term}", []).append(point)
    return curves
