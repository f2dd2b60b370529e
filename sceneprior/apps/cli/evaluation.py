"""Commands that score rooms and write reports; each imports its dependencies when called."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sceneprior.apps.cli import options
from sceneprior.apps.cli.options import option
from sceneprior.core.errors import InputError

if TYPE_CHECKING:
    from sceneprior.evaluation.synthesis import EvalOptions
    from sceneprior.evaluation.use import UseOptions

GENERATED, MEASURED = 1000, 200

SomeRunOption = Annotated[
    str | None, option("The run or prior that makes the rooms, as in `synthesize`.")
]
AlexnetOption = Annotated[
    Path | None, option("The file alexnet-owt-7be5be79.pth, for the paper's SCA.")
]
SplitOption = Annotated[
    str, option("Rooms to compare with: test to report, val to choose settings.")
]
BoxesOption = Annotated[
    bool, option("Also compare layouts only: all rooms drawn as boxes.", "--boxes")
]
ResamplesOption = Annotated[
    int, option("Number of bootstrap resamples; 0 leaves intervals out.", min=0)
]
OutOption = Annotated[Path | None, option("JSON file (default: scores.json in RUN or SCENES).")]


def eval_fid(
    run: SomeRunOption = None,
    scenes: options.Scenes = None,
    count: Annotated[
        int | None,
        option(f"Rooms (default: {GENERATED} of a run, or all scenes).", "-n", "--count", min=2),
    ] = None,
    seed: options.Seed = 0,
    inception: options.Inception = None,
    alexnet: AlexnetOption = None,
    shards: Annotated[
        Path | None, option("Shards with the test rooms (default: those of the run).")
    ] = None,
    split: SplitOption = "test",
    boxes: BoxesOption = False,
    resamples: ResamplesOption = 200,
    out: OutOption = None,
    distribution: options.Distribution = None,
    models: Annotated[
        Path | None, option(f"CAD models to put in place of all objects: {options.MODELS_HELP}")
    ] = None,
) -> None:
    """Compare generated rooms with test rooms, by the distributions of docs/evaluation.md.

    FID and KID are computed only with --inception, the user's Inception network. Without it, the
    Frechet and kernel distances use EfficientNet-Lite0 features; they are not FID or KID, and their
    values cannot be compared with FID or KID. The protocol is written with the scores. `evaluate`
    also measures whether rooms can be used.
    """
    from sceneprior.evaluation.synthesis import EvalOptions

    protocol = EvalOptions(seed, inception, alexnet, split, boxes, resamples)
    _score(run, scenes, count, protocol, shards, out, distribution, models=models)


@options.with_request
def evaluate(
    run: SomeRunOption = None,
    scenes: options.Scenes = None,
    count: Annotated[
        int | None,
        option(f"Rooms (default: {MEASURED} of a run, or all scenes).", "-n", "--count", min=1),
    ] = None,
    seed: options.Seed = 0,
    shards: Annotated[
        Path | None,
        option(
            "Shards with real rooms to compare with (default: those of the run, if they are "
            "there); without shards, nothing is compared."
        ),
    ] = None,
    only_use: Annotated[
        bool, option("Compute only metrics of use, not those of eval-fid.", "--only-use")
    ] = False,
    standing: Annotated[
        bool, option("First make objects stand, as `export --to mujoco` does.", "--stand")
    ] = False,
    settle: Annotated[
        str,
        option(
            "Rooms to simulate: solids (whose objects have solids, or are boxes), all "
            "(divides meshes, a minute or two each), or none."
        ),
    ] = "solids",
    inception: options.Inception = None,
    alexnet: AlexnetOption = None,
    split: SplitOption = "test",
    boxes: BoxesOption = False,
    resamples: ResamplesOption = 200,
    out: OutOption = None,
    distribution: options.Distribution = None,
    asked: Any = None,
) -> None:
    """Measure whether rooms can be used, and compare them with real rooms, as eval-fid does.

    Metrics of use need only scenes: collisions, support, free floor, doors (SceneEval, PhyScene,
    ReSpace), and stability in MuJoCo. With shards, real, shuffled and random rooms are measured for
    comparison, and all metrics of eval-fid are computed; without shards, only the metrics of use.
    """
    from sceneprior.evaluation.synthesis import EvalOptions
    from sceneprior.evaluation.use import UseOptions

    protocol = EvalOptions(seed, inception, alexnet, split, boxes, resamples)
    use = UseOptions(settle, only_use, standing)
    _score(run, scenes, count, protocol, shards, out, distribution, use, asked)


def _score(
    run: str | None,
    scenes: Path | None,
    count: int | None,
    protocol: "EvalOptions",
    shards: Path | None,
    out: Path | None,
    distribution: str | None,
    use: "UseOptions | None" = None,
    asked: dict[str, Any] | None = None,
    models: Path | None = None,
) -> None:
    """Score the rooms of a run, or a folder of scenes; with `use`, by metrics of use as well."""
    from sceneprior.apps.experiments.evaluate import evaluate_folder, evaluate_run
    from sceneprior.core.files import write_json
    from sceneprior.evaluation.score_table import print_scores

    if run is not None and scenes is not None:
        raise InputError(
            "Both --run and --scenes were given; give --run to evaluate rooms that a run "
            "generates, or --scenes to evaluate existing scenes."
        )
    if run is not None:
        target, count = (
            options.result_file(run, out, "scores.json"),
            count or (MEASURED if use else GENERATED),
        )
        found = evaluate_run(run, count, protocol, shards, distribution, use, asked, models)
    elif scenes is not None:
        if (distribution, models) != (None, None):
            raise InputError(
                "--distribution and --models belong to --run; scenes are evaluated as they are."
            )
        if asked:
            raise InputError("Requests belong to --run; scenes are evaluated as they are.")
        if use is None and shards is None:
            raise InputError("--scenes needs --shards: the folder with the test rooms.")
        target = options.checked_target(out or scenes / "scores.json")
        found = evaluate_folder(scenes, count, protocol, shards, use)
    else:
        with_shards = "" if use else " with --shards SHARDS"
        raise InputError(
            f"There is nothing to evaluate; give --run RUN, or --scenes DIR{with_shards}."
        )
    write_json(target, found)
    print_scores(found)
    typer.echo(f"Wrote {target}")


def eval_svr(
    shards: Annotated[Path, option("Shards with 3D ground truth.")],
    run: Annotated[str | None, option("Run to evaluate.")] = None,
    scenes: options.Scenes = None,
    split: Annotated[str, option("Split: train, val or test.")] = "test",
    views: Annotated[int, option("Largest number of views per room.", min=1)] = 1,
    limit: options.Limit = None,
    out: Annotated[Path | None, option("JSON file (default: svr.json in RUN or SCENES).")] = None,
    fit: options.Fit = "objects",
    restarts: options.Restarts = 1,
    models: Annotated[
        Path | None, option(f"CAD models to put in place of the fits, too: {options.MODELS_HELP}")
    ] = None,
    seed: options.Seed = 0,
) -> None:
    """Evaluate single-view reconstruction, with training rooms as baselines."""
    from sceneprior.apps.reconstruction.score import (
        evaluate_run,
        evaluate_scenes,
        print_view_scores,
    )
    from sceneprior.core.files import write_json

    if run is not None and scenes is None:
        target = options.result_file(run, out, "svr.json")
        found = evaluate_run(run, shards, fit, restarts, split, seed, views, limit, models)
    elif scenes is not None and run is None:
        given = (views, limit, fit, restarts, models)
        if given != (1, None, "objects", 1, None):
            raise InputError(
                "--views, --limit, --fit, --restarts and --models belong to --run; scenes are "
                "evaluated as they are."
            )
        target = options.checked_target(out or scenes / "svr.json")
        found = evaluate_scenes(scenes, shards, split, seed)
    else:
        raise InputError("Say what to evaluate: either --run, or --scenes with reconstructions.")
    write_json(target, found)
    print_view_scores(found)
    typer.echo(f"Wrote {target}")


def report(
    run: Annotated[Path | None, option("Folder of a run that `fit` made.")] = None,
    scenes: options.Scenes = None,
    shards: Annotated[Path | None, option("Shards that --scenes were evaluated on.")] = None,
    scores: Annotated[
        Path | None, option("Scores file (default: scores.json in RUN or SCENES).")
    ] = None,
    out: Annotated[
        Path | None, option("HTML file (default: report.html in RUN or SCENES).")
    ] = None,
    seed: options.Seed = 0,
) -> None:
    """Write one self-contained HTML page of a run or of scenes: inputs, curves, rooms, scores."""
    from sceneprior.apps.experiments.report import report_folder, report_run

    if run is not None and (scenes, shards) == (None, None):
        target = out or run / "report.html"
        if run.is_dir():
            options.checked_target(target)
        report_run(run, scores, target, seed)
    elif scenes is not None and shards is not None and run is None:
        if seed != 0:
            raise InputError("--seed belongs to --run; scenes are shown as they are.")
        target = options.checked_target(out or scenes / "report.html")
        report_folder(scenes, shards, scores, target)
    else:
        raise InputError(
            "Say what to report on: either --run RUN, or --scenes DIR --shards SHARDS."
        )
    typer.echo(f"Wrote {target}")
