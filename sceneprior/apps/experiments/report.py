"""Write the report page of a run, or of a folder of the user's scenes."""

from pathlib import Path
from typing import Any

import torch

from sceneprior.apps.config import load_any_run, run_config
from sceneprior.apps.experiments.commands import finished_commands
from sceneprior.apps.experiments.comparison import GIVEN, made_by_run
from sceneprior.apps.experiments.evaluate import decoded_and_true
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.ground_truth import known_in_3d
from sceneprior.core.scene import Scene
from sceneprior.evaluation.report import ROOMS_SHOWN, write_report
from sceneprior.evaluation.score_table import read_scores
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import decode_latents, marked
from sceneprior.render.scene_files import load_scene_folder
from sceneprior.training.method import TrainedSampler, read_metrics

UNFOLDING_STEPS = 7
CURVES = (
    "loss", "class", "box", "completeness", "frustum", "mask", "mask_iou", "shape", "latents",
    "discriminator", "objects", "existence", "position", "size", "kl",
)  # fmt: skip


def report_run(run: Path, scores: Path | None, out: Path, seed: int) -> None:
    """Write the report page of a run, without comparisons if the rooms have no 3D ground truth.

    The page lists the commands recorded beside the run, as those of the demo are, and their time.
    """
    trained = load_any_run(run)
    config, shards = trained.config, Path(trained.config.data.shards)
    found, in_3d = _scores(scores, run, shards, f"--run {run}"), known_in_3d(shards, "train")
    commands, seconds = finished_commands(run.parent)
    keeping = trained if isinstance(trained, TrainedPrior) and trained.remembers_rooms else None
    method = made_by_run(config, trained.distribution)[0] or f"the method {config.method}"
    made_by = f"{method}, which learns from {config.learns_from}"
    if isinstance(trained, TrainedPrior):
        made_by += f"; rooms drawn by: {marked(trained.distribution)}"
    write_report(
        out,
        title=f"New rooms from a prior learnt from {config.learns_from}",
        source=f"run {run.resolve().name}",
        made_by=made_by,
        shards=shards,
        views=not isinstance(trained, TrainedSampler),
        generated=sample_rooms(trained, ROOMS_SHOWN, seed),
        scores=found if seconds is None else found | {"seconds": seconds},
        commands=commands,
        curves=read_curves(run),
        decoded=decoded_and_true(keeping, shards, meshes=True) if keeping and in_3d else [],
        unfolding=unfold(keeping) if keeping else [],
    )


def report_folder(folder: Path, shards: Path, scores: Path | None, out: Path) -> None:
    """Write the report page of the user's scenes, made by any method, without the parts that need
    a run."""
    scenes = load_scene_folder(folder)
    write_report(
        out,
        title="Rooms beside real ones",
        source=f"scenes {folder.resolve().name}",
        made_by=GIVEN,
        shards=shards,
        generated=scenes[:ROOMS_SHOWN],
        scores=_scores(scores, folder, shards, f"--scenes {folder} --shards {shards}"),
        commands=(),
    )


def _scores(path: Path | None, folder: Path, shards: Path, evaluated: str) -> dict[str, Any]:
    """Read the scores that `eval-fid` wrote to a file.

    Args:
        path: The file; None reads `scores.json` of `folder`, which may be missing if the rooms have
            no 3D ground truth.
        evaluated: Arguments of the `eval-fid` command that writes the file, for the error message.
    """
    if path is None:
        path = folder / "scores.json"
        if not path.exists() and not known_in_3d(shards, "test"):
            return {}
    return read_scores(path, f"write them with `sceneprior eval-fid {evaluated}`")


def unfold(trained: TrainedPrior) -> list[Scene]:
    """Rooms along the geodesic between two distant training rooms, from one latent to the other."""
    space = trained.prior.latent_space
    z = space(trained.logits)
    far = z[(z - z[0]).norm(dim=-1).argmax()]
    names = [f"step_{step}" for step in range(UNFOLDING_STEPS)]
    along = torch.linspace(0, 1, UNFOLDING_STEPS)
    return decode_latents(trained, space.between(z[0], far, along), names)


def read_curves(run: Path) -> dict[str, list[tuple[int, float]]]:
    """Loss curves of every stage from its metrics.csv, as `stage/term` -> (epochs, values)."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for stage in run_config(run).stage_names:
        for row in read_metrics(run / stage / "metrics.csv"):
            for term in CURVES:
                if row.get(f"train/{term}"):
                    point = (int(row["epoch"]), float(row[f"train/{term}"]))
                    curves.setdefault(f"{stage}/{term}", []).append(point)
    return curves
