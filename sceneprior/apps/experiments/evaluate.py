"""Evaluate a run, or a folder of the user's scenes, and write their report page."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from sceneprior.apps.config import load_any_run, run_config
from sceneprior.apps.experiments.evaluate_views import (
    evaluate_from_views,
    mask_scores,
)
from sceneprior.apps.experiments.runs import GIVEN, made_by_run
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import InputError
from sceneprior.core.files import write_json
from sceneprior.core.ground_truth import known_in_3d, reference_scenes
from sceneprior.core.scene import Scene
from sceneprior.core.shards import list_shards
from sceneprior.evaluation.metrics.contents import reconstruction_scores
from sceneprior.evaluation.report import ROOMS_SHOWN, write_report
from sceneprior.evaluation.room_sets import seeded_rows
from sceneprior.evaluation.synthesis import FORMAT, EvalOptions, evaluate_synthesis
from sceneprior.evaluation.use import UseOptions, evaluate_use
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import decode_latents, decode_training_rooms, marked
from sceneprior.render.scene_files import load_scene_folder
from sceneprior.training.method import Trained, TrainedSampler

UNFOLDING_STEPS = 7
CURVES = (
    "loss", "class", "box", "completeness", "frustum", "mask", "mask_iou", "shape", "latents",
    "discriminator", "objects", "existence", "position", "size", "kl",
)  # fmt: skip


def evaluate_run(
    run: Path | str,
    count: int,
    options: EvalOptions,
    out: Path,
    shards: Path | None = None,
    distribution: str | None = None,
    use: UseOptions | None = None,
    asked: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Score generated rooms against test rooms (`_scores`), and write the scores.

    The options' seed also draws the latents; `shards` and `distribution` default to the run's.

    Args:
        use: Also compute metrics of use; without shards, compute only these.
        asked: Request for the rooms, as arguments of `Prior.sample`; only with `use`.
    """
    trained = load_any_run(run)
    known: Path | None = shards or Path(trained.config.data.shards)
    if shards is None and known is not None and not known.is_dir():
        if use is None:
            raise InputError(
                f"{run} was trained on shards '{known}', which do not exist; name the shards to "
                "compare with: --shards."
            )
        known = None

    def generate() -> list[Scene]:
        if asked:
            from sceneprior.apps.api import load

            return load(run).sample(count, options.seed, distribution, **asked)
        return sample_rooms(trained, count, options.seed, distribution)

    scores = _scores(generate, known, options, use, trained)
    latents = "its own"
    if isinstance(trained, TrainedPrior):
        latents = marked(distribution or trained.distribution)
    scores["protocol"] |= {"run": Path(run).name, "stage": trained.stage, "latents": latents}
    write_json(out, scores)
    return scores


def evaluate_folder(
    folder: Path,
    count: int | None,
    options: EvalOptions,
    out: Path,
    shards: Path | None,
    use: UseOptions | None = None,
) -> dict[str, Any]:
    """Score `count` of the user's scenes (None: all), of any method, against test rooms, and write
    the scores; with `use`, metrics of use are added and `shards` are optional."""
    scenes = load_scene_folder(folder)
    if count is not None and count > len(scenes):
        raise InputError(
            f"{count} scenes are to be evaluated, but {folder} holds {len(scenes)}; leave out -n "
            "to take all of them, or make more."
        )
    rows = seeded_rows(len(scenes), count or len(scenes), options.seed)
    scores = _scores(lambda: [scenes[row] for row in rows], shards, options, use)
    scores["protocol"] |= {"scenes": folder.resolve().name, "n_scenes_available": len(scenes)}
    write_json(out, scores)
    return scores


def _scores(
    generate: Callable[[], list[Scene]],
    shards: Path | None,
    options: EvalOptions,
    use: UseOptions | None,
    trained: Trained | None = None,
) -> dict[str, Any]:
    """Scores of rooms against the test rooms of shards, and their metrics of use.

    If a run keeps the latents of its training rooms, these rooms are decoded and scored as well:
    against their 3D ground truth or, if the shards have none, against the observed masks. This
    comes first, because it refuses shards that are not the run's.
    """
    if shards is not None:
        list_shards(shards, options.split)  # raises if the split has no rooms
    in_3d = shards is not None and known_in_3d(shards, options.split)
    keeping = trained if isinstance(trained, TrainedPrior) and trained.remembers_rooms else None
    scores: dict[str, Any] | None = None
    if shards is None or (use is not None and use.alone):
        generated = generate()
    elif in_3d:
        pairs = [] if keeping is None else decoded_and_true(keeping, shards)
        generated = generate()
        scores = evaluate_synthesis(generated, shards, options, [decoded for decoded, _ in pairs])
        if pairs:
            scores |= reconstruction_scores(pairs)
    else:
        masks = {} if keeping is None else mask_scores(keeping, shards)
        generated = generate()
        scores = evaluate_from_views(generated, shards, options) | masks
    if use is not None:
        scores = evaluate_use(generated, options, use, shards if in_3d else None, scores)
    assert scores is not None  # without `use`, there are shards
    return scores


def decoded_and_true(
    trained: Trained, shards: Path, meshes: bool = False
) -> list[tuple[Scene, Scene]]:
    """Pairs of each decoded training room and its 3D ground truth, which training does not use.

    The truth holds only tracked objects, since other objects appear in no view. Rotated copies of
    rooms are left out. `meshes` loads the true meshes, which pictures need and scores of boxes do
    not.
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
    run: Path, scores: Path | None, out: Path, seed: int, commands: tuple[str, ...]
) -> None:
    """Write the report page of a run, without comparisons if the rooms have no 3D ground truth."""
    trained = load_any_run(run)
    config, shards = trained.config, Path(trained.config.data.shards)
    found = read_scores(scores, run, shards, f"--run {run}")
    decoded: list[tuple[Scene, Scene]] = []
    unfolding: list[Scene] = []
    if isinstance(trained, TrainedPrior) and trained.remembers_rooms:
        if known_in_3d(shards, "train"):
            decoded = decoded_and_true(trained, shards, meshes=True)
        unfolding = unfold(trained)
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
        scores=found,
        commands=commands,
        curves=read_curves(run),
        decoded=decoded,
        unfolding=unfolding,
    )


def report_folder(
    folder: Path, shards: Path, scores: Path | None, out: Path, commands: tuple[str, ...]
) -> None:
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
        scores=read_scores(scores, folder, shards, f"--scenes {folder} --shards {shards}"),
        commands=commands,
    )


def read_scores(path: Path | None, folder: Path, shards: Path, evaluated: str) -> dict[str, Any]:
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
    try:
        found = json.loads(path.read_text())
        if not isinstance(found, dict) or found.get("format") != FORMAT:
            raise ValueError("another file")
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} holds no scores ({error}); write them with `sceneprior eval-fid {evaluated}`."
        ) from None
    return found


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
