"""The commands evaluate and eval-fid; they import their dependencies when called."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sceneprior.apps.cli import options
from sceneprior.core.errors import InputError

if TYPE_CHECKING:
    from sceneprior.evaluation.synthesis import EvalOptions
    from sceneprior.evaluation.use import UseOptions

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
    scenes: options.Scenes = None,
    count: Annotated[
        int | None,
        typer.Option(
            "-n", "--count", min=2, help=f"Rooms (default: {GENERATED} of a run, or all scenes)."
        ),
    ] = None,
    seed: options.Seed = 0,
    inception: options.Inception = None,
    alexnet: AlexnetOption = None,
    shards: Annotated[
        Path | None, typer.Option(help="Shards with the test rooms (default: those of the run).")
    ] = None,
    split: SplitOption = "test",
    boxes: BoxesOption = False,
    resamples: ResamplesOption = 200,
    out: OutOption = None,
    distribution: options.Distribution = None,
) -> None:
    """Compare generated rooms with test rooms, by the distributions of docs/evaluation.md.

    FID and KID are computed only with --inception, the user's Inception network. Without it, the
    Frechet and kernel distances use EfficientNet-Lite0 features; they are not FID or KID, and their
    values cannot be compared with FID or KID. The protocol is written with the scores. `evaluate`
    also measures whether rooms can be used.
    """
    from sceneprior.evaluation.synthesis import EvalOptions

    protocol = EvalOptions(seed, inception, alexnet, split, boxes, resamples)
    _score(run, scenes, count, protocol, shards, out, distribution)


@options.with_request
def evaluate(
    run: SomeRunOption = None,
    scenes: options.Scenes = None,
    count: Annotated[
        int | None,
        typer.Option(
            "-n", "--count", min=1, help=f"Rooms (default: {MEASURED} of a run, or all scenes)."
        ),
    ] = None,
    seed: options.Seed = 0,
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
        found = evaluate_run(run, count, protocol, shards, distribution, use, asked)
    elif scenes is not None:
        if distribution is not None:
            raise InputError("--distribution belongs to --run; scenes are evaluated as they are.")
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
