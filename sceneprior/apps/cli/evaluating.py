"""The command eval-fid; it imports its dependencies when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.apps.cli.options import (
    DistributionOption,
    InceptionOption,
    RendererOption,
    ScenesOption,
    SeedOption,
    checked_target,
    result_file,
)
from sceneprior.core.errors import InputError

GENERATED = 1000


def eval_fid(
    run: Annotated[
        str | None, typer.Option(help="The run or prior that makes the rooms, as in `synthesize`.")
    ] = None,
    scenes: ScenesOption = None,
    count: Annotated[
        int | None,
        typer.Option(
            "-n", "--count", min=2, help=f"Rooms (default: {GENERATED} of a run, or all scenes)."
        ),
    ] = None,
    seed: SeedOption = 0,
    inception: InceptionOption = None,
    alexnet: Annotated[
        Path | None, typer.Option(help="The file alexnet-owt-7be5be79.pth, for the paper's SCA.")
    ] = None,
    shards: Annotated[
        Path | None, typer.Option(help="Shards with the test rooms (default: those of the run).")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="File (.npz) that keeps the features of real rooms' pictures; read if it exists."
        ),
    ] = None,
    split: Annotated[
        str, typer.Option(help="Rooms to compare with: test to report, val to choose settings.")
    ] = "test",
    boxes: Annotated[
        bool, typer.Option("--boxes", help="Compare layouts alone, too: all rooms as boxes.")
    ] = False,
    resamples: Annotated[
        int, typer.Option(min=0, help="Number of bootstrap resamples; 0 leaves intervals out.")
    ] = 200,
    out: Annotated[
        Path | None, typer.Option(help="JSON file (default: scores.json in RUN or SCENES).")
    ] = None,
    distribution: DistributionOption = None,
    renderer: RendererOption = "auto",
) -> None:
    """Compare generated rooms with test rooms, by all metrics of docs/evaluation.md.

    FID and KID are computed only with --inception, the user's Inception network. Without it, the
    Frechet and kernel distances use EfficientNet-Lite0 features; they are not FID or KID, and their
    values cannot be compared with FID or KID. The protocol is written with the scores.
    """
    from sceneprior.apps.experiments.evaluate import evaluate_folder, evaluate_run
    from sceneprior.evaluation.score_table import print_scores
    from sceneprior.evaluation.synthesis import EvalOptions

    if run is not None and scenes is not None:
        raise InputError(
            "Both --run and --scenes were given; give --run to evaluate rooms that a run "
            "generates, or --scenes to evaluate existing scenes."
        )
    options = EvalOptions(seed, inception, alexnet, reference, split, boxes, resamples, renderer)
    if run is not None:
        target = result_file(run, out, "scores.json")
        found = evaluate_run(run, count or GENERATED, options, target, shards, distribution)
    elif scenes is not None:
        if shards is None:
            raise InputError("--scenes needs --shards: the folder with the test rooms.")
        if distribution is not None:
            raise InputError("--distribution belongs to --run; scenes are evaluated as they are.")
        target = checked_target(out or scenes / "scores.json")
        found = evaluate_folder(scenes, count, options, target, shards)
    else:
        raise InputError(
            "There is nothing to evaluate; give --run RUN, or --scenes DIR with --shards SHARDS."
        )
    print_scores(found)
    typer.echo(f"Wrote {target}")
