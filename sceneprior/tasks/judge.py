"""A run in; its scores and its report page out."""

import csv
import json
from pathlib import Path
from typing import Any

import torch

from sceneprior.errors import InputError
from sceneprior.evaluation.layout_metrics import reconstruction_scores
from sceneprior.evaluation.protocol import evaluate_synthesis, write_scores
from sceneprior.evaluation.reference import reference_scenes
from sceneprior.evaluation.report import write_report
from sceneprior.offscreen import open_renderer
from sceneprior.scene import Scene
from sceneprior.stages.runs import STAGES, TrainedPrior, load_run
from sceneprior.tasks.decode import decode_latents, decode_training_rooms, synthesize

UNFOLDING_STEPS = 7
CURVES = (
    "loss", "class", "box", "completeness", "frustum", "mask", "mask_iou", "discriminator",
    "objects",
)  # fmt: skip


def judge_run(
    run: Path,
    count: int,
    seed: int,
    inception: Path | None,
    shards: Path | None,
    out: Path,
    law: str | None,
    renderer: str,
    checkpoint: str = "final",
) -> dict[str, Any]:
    """Score generated rooms against test rooms, and decoded training rooms, in runs that remember
    them, against the truth.

    Args:
        run: A run's folder.
        count: Rooms to generate.
        seed: Of their latents.
        inception: TorchScript file for FID proper, or None.
        shards: Folder with the test rooms; None takes the run's own.
        out: JSON file to write.
        law: Sampling law; None takes the config's.
        renderer: Kind of renderer.
        checkpoint: `final` or `best`.

    Raises:
        InputError: the run, the shards or the Inception file cannot be used.
    """
    trained = load_run(run, checkpoint)
    folder = shards or Path(trained.config.data.shards)
    generated = synthesize(trained, count, seed, law)
    scores = evaluate_synthesis(
        generated, folder, inception=inception, seed=seed, renderer=open_renderer(renderer)
    )
    if trained.remembers_rooms:
        scores |= reconstruction_scores(decoded_and_true(trained, folder))
    scores["protocol"]["run"] = Path(run).resolve().name
    scores["protocol"]["stage"] = trained.stage
    scores["protocol"]["checkpoint"] = checkpoint
    scores["protocol"]["sampling_law"] = law or trained.law
    write_scores(scores, out)
    return scores


def decoded_and_true(trained: TrainedPrior, shards: Path) -> list[tuple[Scene, Scene]]:
    """Training rooms as decoded, each with what training never saw: the room in 3D.

    Only tracked objects count: what no camera saw, nobody can know. Turned copies of a room
    are left out.
    """
    truth = {scene.name: scene for scene in reference_scenes(shards, "train", tracked_only=True)}
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
    """Write the page of a run.

    Raises:
        InputError: the run or its scores cannot be read.
    """
    trained = load_run(run, checkpoint)
    try:
        figures = json.loads(scores.read_text())
    except (OSError, ValueError) as error:
        raise InputError(
            f"{scores} holds no scores ({error}); write them with "
            f"`sceneprior eval-fid --run {run}`."
        ) from None
    shards = Path(trained.config.data.shards)
    decoded: list[tuple[Scene, Scene]] = []
    unfolding: list[Scene] = []
    if trained.remembers_rooms:
        decoded, unfolding = decoded_and_true(trained, shards), unfold(trained)
    write_report(
        out,
        title="New rooms from a prior learnt from masks",
        shards=shards,
        run=run,
        generated=synthesize(trained, 8, seed),
        scores=figures,
        commands=commands,
        curves=read_curves(run),
        decoded=decoded,
        unfolding=unfolding,
        renderer=open_renderer(renderer),
    )


def unfold(trained: TrainedPrior) -> list[Scene]:
    """Rooms between two training rooms that lie far apart: on the sphere, along the geodesic."""
    space = trained.prior.sphere
    z = space(trained.logits)
    end = int(space.nearness(z[:1], z).argmin())
    start, far = z[:1].expand(UNFOLDING_STEPS, -1), z[end].expand(UNFOLDING_STEPS, -1)
    names = [f"step_{step}" for step in range(UNFOLDING_STEPS)]
    along = torch.linspace(0, 1, UNFOLDING_STEPS)
    return decode_latents(trained, space.between(start, far, along), names)


def read_curves(run: Path) -> dict[str, list[tuple[int, float]]]:
    """Loss curves of every stage from its metrics.csv, as `stage/term` -> (epoch, value)."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for stage in STAGES:
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
