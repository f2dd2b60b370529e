"""Verbs that judge rooms; what a verb needs it imports when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.cli.options import (
    CheckpointOption,
    DistributionOption,
    InceptionOption,
    OverwriteOption,
    RendererOption,
)
from sceneprior.errors import InputError

GENERATED = 1000


def eval_fid(
    run: Annotated[
        Path | None, typer.Option(help="Folder of a run that `fit` made; it generates the rooms.")
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
        Path | None, typer.Option(help="Shards to judge against (default: those of the run).")
    ] = None,
    reference: Annotated[
        Path | None,
        typer.Option(
            help="Keep what real rooms' pictures say in this .npz, or take it from there."
        ),
    ] = None,
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
    """Judge generated rooms against test rooms, with the whole protocol beside the figures."""
    from sceneprior.evaluation.score_table import print_scores
    from sceneprior.experiments.evaluate import Judging, judge_folder, judge_run

    if run is not None and scenes is not None:
        raise InputError(
            "Both --run and --scenes came; give --run to judge what a run generates, or --scenes "
            "to judge scenes that are there."
        )
    judging = Judging(inception, alexnet, reference, resamples, renderer, boxes)
    if run is not None:
        target = out or run / "scores.json"
        scores = judge_run(
            run, count or GENERATED, seed, shards, target, distribution, judging, checkpoint
        )
    elif scenes is not None:
        if shards is None:
            raise InputError("--scenes needs --shards: the folder with the test rooms.")
        if distribution is not None or checkpoint != "final":
            raise InputError(
                "--distribution and --checkpoint belong to --run; scenes are judged as they are."
            )
        target = out or scenes / "scores.json"
        scores = judge_folder(scenes, count, seed, shards, target, judging)
    else:
        raise InputError(
            "There is nothing to judge; give --run RUN, or --scenes DIR with --shards SHARDS."
        )
    print_scores(scores)
    typer.echo(f"Wrote {target}")


def convert_boxes(
    boxes: Annotated[
        Path, typer.Argument(help="A .npz or .json of boxes, or a folder of them (boxes.npz each).")
    ],
    out: Annotated[Path, typer.Option(help="Folder for the scenes.")],
    label_set: Annotated[str, typer.Option(help="Of the scenes, such as front3d_bedroom.")],
    classes: Annotated[
        str | None,
        typer.Option(help="Names of the columns, comma-separated (default: the label set's)."),
    ] = None,
    sizes: Annotated[
        str, typer.Option(help="half: half extents, as ATISS writes them; full: whole ones.")
    ] = "half",
    overwrite: OverwriteOption = False,
) -> None:
    """Turn box lists of ATISS and its kin into scenes that eval-fid judges."""
    from sceneprior.evaluation.convert import convert

    count = convert(boxes, out, label_set, classes, sizes, overwrite)
    typer.echo(f"Wrote {count} rooms to {out}")
