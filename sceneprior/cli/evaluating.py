"""The command eval-fid; what it needs it imports when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.cli.options import (
    CheckpointOption,
    DistributionOption,
    InceptionOption,
    RendererOption,
    result_file,
)
from sceneprior.errors import InputError

GENERATED = 1000


def eval_fid(
    run: Annotated[
        str | None, typer.Option(help="A run or prior, as `synthesize` takes; it makes the rooms.")
    ] = None,
    scenes: Annotated[
        Path | None, typer.Option(help="Instead of a run: a folder of scene JSONs, of any method.")
    ] = None,
    count: Annotated[
        int | None,
        typer.Option(
            "-n", "--count", min=2, help=f"Rooms (default: {GENERATED} of a run, or all scenes)."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the rooms, folds and resamples.")] = 0,
    inception: InceptionOption = None,
    alexnet: Annotated[
        Path | None, typer.Option(help="alexnet-owt-7be5be79.pth, for the paper's SCA.")
    ] = None,
    shards: Annotated[
        Path | None, typer.Option(help="Shards to compare with (default: those of the run).")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Keep features of real rooms' pictures in this .npz, or take them from there."
        ),
    ] = None,
    split: Annotated[
        str, typer.Option(help="Rooms to compare with: test to report, val to choose settings by.")
    ] = "test",
    boxes: Annotated[
        bool, typer.Option("--boxes", help="Also compare all rooms as boxes: layouts alone.")
    ] = False,
    resamples: Annotated[
        int, typer.Option(min=0, help="Of the bootstrap intervals; 0 leaves them out.")
    ] = 200,
    out: Annotated[
        Path | None, typer.Option(help="JSON file (default: scores.json in RUN or SCENES).")
    ] = None,
    distribution: DistributionOption = None,
    checkpoint: CheckpointOption = "final",
    renderer: RendererOption = "auto",
) -> None:
    """Compare generated rooms with test rooms, by all metrics of docs/evaluation.md.

    FID and KID are measured only with --inception, the user's Inception network: without it, the
    Frechet and kernel distances are those of EfficientNet-Lite0 features, which are not FID and
    have other sizes. The whole protocol stands beside the scores.
    """
    from sceneprior.evaluation.score_table import print_scores
    from sceneprior.evaluation.synthesis import EvalOptions
    from sceneprior.experiments.evaluate import evaluate_folder, evaluate_run

    if run is not None and scenes is not None:
        raise InputError(
            "Both --run and --scenes came; give --run to evaluate what a run generates, or "
            "--scenes to evaluate scenes that are there."
        )
    options = EvalOptions(seed, inception, alexnet, reference, split, boxes, resamples, renderer)
    if run is not None:
        target = result_file(run, out, "scores.json")
        rooms = count or GENERATED
        found = evaluate_run(run, rooms, options, target, shards, distribution, checkpoint)
    elif scenes is not None:
        if shards is None:
            raise InputError("--scenes needs --shards: the folder with the test rooms.")
        if distribution is not None or checkpoint != "final":
            raise InputError(
                "--distribution and --checkpoint belong to --run; scenes are evaluated as they are."
            )
        target = out or scenes / "scores.json"
        found = evaluate_folder(scenes, count, options, target, shards)
    else:
        raise InputError(
            "There is nothing to evaluate; give --run RUN, or --scenes DIR with --shards SHARDS."
        )
    print_scores(found)
    typer.echo(f"Wrote {target}")
