"""The commands evaluate and eval-fid; they import their dependencies when called."""

from pathlib import Path
from typing import Annotated, Any

import typer

from sceneprior.apps.cli.options import (
    DistributionOption,
    InceptionOption,
    ScenesOption,
    SeedOption,
    checked_target,
    result_file,
    with_request,
)
from sceneprior.core.errors import InputError

GENERATED, MEASURED = 1000, 200

SomeRunOption = Annotated[
    str | None, typer.Option(help="The run or prior that makes the rooms, as in `synthesize`.")
]
AlexnetOption = Annotated[
    Path | None, typer.Option(help="The file alexnet-owt-7be5be79.pth, for the paper's SCA.")
]
SplitOption = Annotated[
    str, typer.Option(help="Rooms to compare with: test to report, val to choose settings.")
]
BoxesOption = Annotated[
    bool, typer.Option("--boxes", help="Also compare layouts only: all rooms drawn as boxes.")
]
ResamplesOption = Annotated[
    int, typer.Option(min=0, help="Number of bootstrap resamples; 0 leaves intervals out.")
]
OutOption = Annotated[
    Path | None, typer.Option(help="JSON file (default: scores.json in RUN or SCENES).")
]


def eval_fid(
    run: SomeRunOption = None,
    scenes: ScenesOption = None,
    count: Annotated[
        int | None,
        typer.Option(
            "-n", "--count", min=2, help=f"Rooms (default: {GENERATED} of a run, or all scenes)."
        ),
    ] = None,
    seed: SeedOption = 0,
    inception: InceptionOption = None,
    alexnet: AlexnetOption = None,
    shards: Annotated[
        Path | None, typer.Option(help="Shards with the test rooms (default: those of the run).")
    ] = None,
    split: SplitOption = "test",
    boxes: BoxesOption = False,
    resamples: ResamplesOption = 200,
    out: OutOption = None,
    distribution: DistributionOption = None,
) -> None:
    """Compare generated rooms with test rooms, by the distributions of docs/evaluation.md.

    FID and KID are computed only with --inception, the user's Inception network. Without it, the
    Frechet and kernel distances use EfficientNet-Lite0 features; they are not FID or KID, and their
    values cannot be compared with FID or KID. The protocol is written with the scores. `evaluate`
    also measures whether rooms can be used.
    """
    from sceneprior.apps.experiments.evaluate import evaluate_folder, evaluate_run
    from sceneprior.evaluation.synthesis import EvalOptions

    _check_source(run, scenes, distribution)
    options = EvalOptions(seed, inception, alexnet, split, boxes, resamples)
    if run is not None:
        target = result_file(run, out, "scores.json")
        found = evaluate_run(run, count or GENERATED, options, target, shards, distribution)
    elif scenes is not None and shards is not None:
        target = checked_target(out or scenes / "scores.json")
        found = evaluate_folder(scenes, count, options, target, shards)
    elif scenes is not None:
        raise InputError("--scenes needs --shards: the folder with the test rooms.")
    else:
        raise InputError(
            "There is nothing to evaluate; give --run RUN, or --scenes DIR with --shards SHARDS."
        )
    _print(found, target)


@with_request
def evaluate(
    run: SomeRunOption = None,
    scenes: ScenesOption = None,
    count: Annotated[
        int | None,
        typer.Option(
            "-n", "--count", min=1, help=f"Rooms (default: {MEASURED} of a run, or all scenes)."
        ),
    ] = None,
    seed: SeedOption = 0,
    shards: Annotated[
        Path | None,
        typer.Option(
            help="Shards with real rooms to compare with (default: those of the run, if they are "
            "there); without shards, nothing is compared."
        ),
    ] = None,
    only_use: Annotated[
        bool,
        typer.Option("--only-use", help="Compute only metrics of use, not those of eval-fid."),
    ] = False,
    standing: Annotated[
        bool,
        typer.Option("--stand", help="First make objects stand, as `export --to mujoco` does."),
    ] = False,
    settle: Annotated[
        str,
        typer.Option(
            help="Rooms to simulate: solids (whose objects have solids, or are boxes), all "
            "(divides meshes, a minute or two each), or none."
        ),
    ] = "solids",
    inception: InceptionOption = None,
    alexnet: AlexnetOption = None,
    split: SplitOption = "test",
    boxes: BoxesOption = False,
    resamples: ResamplesOption = 200,
    out: OutOption = None,
    distribution: DistributionOption = None,
    asked: Any = None,
) -> None:
    """Measure whether rooms can be used, and compare them with real rooms, as eval-fid does.

    Metrics of use need only scenes: collisions, support, free floor, doors (SceneEval, PhyScene,
    ReSpace), and stability in MuJoCo. With shards, real, shuffled and random rooms are measured for
    comparison, and all metrics of eval-fid are computed; without shards, only the metrics of use.
    """
    from sceneprior.apps.experiments.evaluate import evaluate_folder, evaluate_run
    from sceneprior.evaluation.synthesis import EvalOptions
    from sceneprior.evaluation.use import UseOptions

    _check_source(run, scenes, distribution)
    options = EvalOptions(seed, inception, alexnet, split, boxes, resamples)
    use = UseOptions(settle, only_use, standing)
    if run is not None:
        target = result_file(run, out, "scores.json")
        found = evaluate_run(
            run, count or MEASURED, options, target, shards, distribution, use, asked
        )
    elif scenes is not None:
        if asked:
            raise InputError("Requests belong to --run; scenes are evaluated as they are.")
        target = checked_target(out or scenes / "scores.json")
        found = evaluate_folder(scenes, count, options, target, shards, use)
    else:
        raise InputError("There is nothing to evaluate; give --run RUN, or --scenes DIR.")
    _print(found, target)


def _check_source(run: str | None, scenes: Path | None, distribution: str | None) -> None:
    if run is not None and scenes is not None:
        raise InputError(
            "Both --run and --scenes were given; give --run to evaluate rooms that a run "
            "generates, or --scenes to evaluate existing scenes."
        )
    if scenes is not None and distribution is not None:
        raise InputError("--distribution belongs to --run; scenes are evaluated as they are.")


def _print(found: dict[str, Any], target: Path) -> None:
    from sceneprior.evaluation.score_table import print_scores

    print_scores(found)
    typer.echo(f"Wrote {target}")
