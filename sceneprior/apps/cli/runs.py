"""Commands that train (fit, compare and demo, which run others) and share: pack, priors, export.

Each imports its dependencies when it is called.
"""

import pkgutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from sceneprior.apps.cli import options
from sceneprior.apps.cli.options import option
from sceneprior.core.errors import InputError
from sceneprior.core.files import check_free

TABLES = "compare/paper.yaml"


def fit(
    config: Annotated[str, option("Config: a YAML file, or a shipped one (demo.yaml).")],
    run: Annotated[
        Path | None, option("Folder for checkpoints and logs (default: runs/<config>).")
    ] = None,
    set_: Annotated[
        list[str] | None, option("Changed key: model.width=256; repeatable.", "--set")
    ] = None,
    resume: Annotated[bool, option("Continue a stopped run.", "--resume")] = False,
    init_from: Annotated[
        Path | None, option("Run or checkpoint whose weights training starts with.")
    ] = None,
    logger: Annotated[
        list[str] | None, option("Logger: csv, tensorboard or wandb; repeatable.")
    ] = None,
    devices: Annotated[
        str | None, option("Number or list of devices; short for --set trainer.devices=...")
    ] = None,
    accelerator: options.Accelerator = None,
    precision: Annotated[str | None, option("32-true (default) or bf16-mixed.")] = None,
) -> None:
    """Train the stages of a run, one after the other."""
    from sceneprior.apps.config import load_config
    from sceneprior.core.settings import as_value

    changed = [*(set_ or ()), *([f"init_from={as_value(str(init_from))}"] if init_from else ())]
    settings = load_config(config, tuple(changed))  # before imports that take seconds
    folder = run or Path("runs") / Path(config).stem
    from sceneprior.training.fit import fit as run_fit

    chosen = {"devices": devices, "accelerator": accelerator, "precision": precision}
    try:
        run_fit(settings, folder, resume, tuple(logger or ("csv", "tensorboard")), chosen)
    except KeyboardInterrupt:
        saved = folder / "config.yaml"
        said = "Stopped before training began; run the same command again."
        if saved.is_file():
            go_on = f"sceneprior fit --config {saved} --run {folder} --resume"
            said = f"Stopped and saved. Continue with: {go_on}"
        typer.echo(said, err=True)
        raise typer.Exit(130) from None
    dry = settings.trainer.get("fast_dev_run")
    typer.echo("Every stage can train; nothing is kept." if dry else f"Trained: {folder}")


@contextmanager
def _stopped_by_ctrl_c() -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        typer.echo("Stopped. Run the same command again to continue.", err=True)
        raise typer.Exit(130) from None


def _main(arguments: list[str]) -> int | None:
    """The command line itself, for commands that run others; by name, since it imports this."""
    app = pkgutil.resolve_name("sceneprior.apps.cli.commands:app")
    status: int | None = app(arguments, standalone_mode=False)
    return status


def compare(
    sources: Annotated[
        list[str] | None,
        typer.Argument(
            help="Folders of scenes, priors, runs or result files (scores.json) to tabulate, in "
            "place of trainings."
        ),
    ] = None,
    against: Annotated[
        Path | None, option("Shards with the real rooms that SOURCES are compared with.")
    ] = None,
    count: Annotated[
        int | None,
        option(
            "Rooms of each source (default: the smallest folder's, or the number of training "
            "rooms).",
            "-n",
            "--count",
            min=2,
        ),
    ] = None,
    config: Annotated[
        str, option("Comparison: your YAML, or a shipped one (compare/single_view.yaml).")
    ] = TABLES,
    out: Annotated[Path, option("Folder for runs and tables.")] = Path("out/compare"),
    methods: Annotated[str | None, option("Methods, such as lifted,lstm.")] = None,
    rooms: Annotated[str | None, option("Kinds of rooms, such as bedroom.")] = None,
    seeds: Annotated[str | None, option("Seeds, such as 0,1 (default: all).")] = None,
    inception: options.Inception = None,
    accelerator: options.Accelerator = None,
) -> None:
    """Tabulate methods: train and evaluate those of a config, or evaluate SOURCES as they are.

    A stopped comparison is continued by running it again. Result files of other protocols are set
    apart.
    """
    if sources:
        if (config, methods, rooms, seeds, accelerator) != (TABLES, None, None, None, None):
            raise InputError(
                "--config, --methods, --rooms, --seeds and --accelerator are for comparisons that "
                "train; leave them out, or name no SOURCES."
            )
        from sceneprior.apps.experiments.sources import compare_sources
        from sceneprior.evaluation.synthesis import EvalOptions

        settings = EvalOptions(inception=inception, boxes=True)
        tables = compare_sources(sources, against, out, count, settings)
        typer.echo(f"Wrote {out / 'table.html'}, table.md and table.csv")
        if tables > 1:
            typer.echo(
                f"Note: the results have {tables} protocols, and a table for each; values of two "
                "tables cannot be compared.",
                err=True,
            )
        return
    if against is not None or count is not None:
        raise InputError("--against and -n belong to SOURCES; name folders, priors or results.")
    from sceneprior.apps.experiments.compare import compare as run_comparison
    from sceneprior.apps.experiments.compare import part_of
    from sceneprior.apps.experiments.comparison import load_comparison

    comparison = load_comparison(config)
    part = part_of(comparison, out, methods, rooms, seeds)
    with _stopped_by_ctrl_c():
        done = run_comparison(comparison, part, out, _main, inception, accelerator)
    if done.table is not None:
        typer.echo(f"Wrote {done.table}")
    if done.left_out:
        typer.echo(
            "Not in the table, because trained or evaluated with other settings, rooms, seeds or "
            f"weights: {'; '.join(done.left_out)}. Name them in the options to "
            "evaluate them again.",
            err=True,
        )
    if done.failures:
        raise InputError(
            f"{len(done.failures)} runs failed and are not in the table: {'; '.join(done.failures)}"
        )


def demo(
    out: Annotated[Path, option("Folder for everything the demo makes.")] = Path("out/demo"),
    config: Annotated[str, option("Config of the training run.")] = "demo.yaml",
    rooms: Annotated[int, option("Number of homes to make.", min=20)] = 240,
    count: Annotated[int, option("Number of rooms to generate.", min=2)] = 200,
) -> None:
    """Run the whole pipeline on procedural homes: shards, training, new rooms, scores, a page."""
    from sceneprior.apps.experiments.commands import run_demo

    with _stopped_by_ctrl_c():
        run_demo(out, config, rooms, count, _main)
    typer.echo(f"Open {out / 'report.html'}; scores are in {out / 'scores.json'}.")


def pack(
    run: Annotated[Path, typer.Argument(help="Folder of a run that `fit` made.")],
    out: Annotated[Path, option("The file to write, such as bedroom.prior.")],
    about: Annotated[
        Path | None, option("Markdown file on the data, their authors and licence, for the card.")
    ] = None,
    scores: Annotated[
        Path | None, option("Scores for the card (default: RUN/scores.json).")
    ] = None,
    latents: Annotated[
        bool, option("Keep the latents and ids of the training rooms.", "--latents")
    ] = False,
    half: Annotated[bool, option("Store large tensors in half precision.", "--half")] = False,
    overwrite: options.Overwrite = False,
) -> None:
    """Write a trained run to one file for sharing: weights, settings, a card; no pickle."""
    from sceneprior.apps.config import load_any_run, run_config
    from sceneprior.apps.priors.card import model_card
    from sceneprior.apps.priors.packed import pack as packed_of
    from sceneprior.apps.priors.packed import write_packed
    from sceneprior.core.files import read_bytes
    from sceneprior.evaluation.score_table import read_scores
    from sceneprior.lifted.trained import SAMPLER
    from sceneprior.paper.prior import TrainedPrior

    if out.exists() and (out.is_dir() or not overwrite):
        raise InputError(f"{out} already exists; name another file, or add --overwrite.")
    found = scores or run / "scores.json"
    measured = None
    if scores is not None or found.is_file():
        measured = read_scores(found, f"write them with `sceneprior eval-fid --run {run}`")
    stated = None if about is None else read_bytes(about).decode("utf-8-sig", "replace")
    run_config(run)
    trained = load_any_run(run)
    card = model_card(trained, out.stem, stated, measured, latents, half)
    write_packed(packed_of(trained, card, latents, half), out)
    typer.echo(f"Wrote {out} ({out.stat().st_size / 1e6:.1f} MB)")
    if stated is None:
        typer.echo(
            "Note: the card does not state the data's authors and licence; --about adds them.",
            err=True,
        )
    alone = isinstance(trained, TrainedPrior) and trained.distribution not in (SAMPLER, "paper")
    if alone and not latents:
        typer.echo(
            f"Note: the run draws rooms from '{trained.distribution}', which needs --latents; with "
            "this file they are drawn from 'paper'.",
            err=True,
        )


def priors(
    name: Annotated[
        str | None, typer.Argument(help="Prior whose card to print, as in `synthesize`.")
    ] = None,
) -> None:
    """List the shipped priors with their rooms, classes and scores, or print a prior's card."""
    from sceneprior.apps.priors.listing import listing
    from sceneprior.apps.priors.packed import find_prior, is_packed, read_packed, shipped_priors

    if name is not None:
        path = find_prior(name)
        if not is_packed(path):
            raise InputError(f"{name} is a run, which has no card; `sceneprior pack` writes one.")
        typer.echo(read_packed(path).card, nl=False)
        return
    shipped = shipped_priors().items()
    typer.echo("\n\n".join(listing(known, path) for known, path in shipped))
    typer.echo("\n`sceneprior priors NAME` prints the card of one, with all scores.")


def export(
    source: Annotated[
        Path, typer.Argument(help="Folder of scenes, or of box lists for `--to scenes`.")
    ],
    to: Annotated[
        str, option("Format: mujoco, usd, habitat, sceneeval, obj, atiss, threed-front; or scenes.")
    ],
    out: Annotated[Path, option("Folder to write to.")],
    label_set: Annotated[
        str | None, option("Label set of box lists, such as front3d_bedroom.")
    ] = None,
    classes: Annotated[
        str | None, option("Names of the columns of box lists (default: the label set's).")
    ] = None,
    sizes: Annotated[
        str | None, option("Extents in box lists: half, as ATISS writes them (default), or full.")
    ] = None,
    shell: options.Shell = None,
    strict: Annotated[
        bool, option("Exit with status 3 if an object is left out.", "--strict")
    ] = False,
    overwrite: options.Overwrite = False,
) -> None:
    """Export scenes to another format, or convert box lists, such as ATISS's, to scenes.

    For simulators, walls are added unless --shell says otherwise, and objects are moved until they
    stand and do not overlap. Objects that the format or the room has no place for are named.
    """
    from sceneprior.apps.rooms import write_scenes
    from sceneprior.interchange.box_lists import read_box_lists
    from sceneprior.interchange.export import export_scenes
    from sceneprior.render.scene_files import load_scene_folder

    check_free(out, overwrite)
    left_out: Sequence[str] = ()
    asked = None if shell is None else options.checked_shell(shell)
    if to == "scenes":
        if label_set is None:
            raise InputError("--to scenes needs --label-set, the label set of the box lists.")
        rooms = read_box_lists(source, label_set, classes, sizes or "half")
        write_scenes(rooms, out, "none" if asked is None else asked)
    else:
        if (label_set, classes, sizes) != (None, None, None):
            raise InputError("--label-set, --classes and --sizes apply only with --to scenes.")
        rooms = load_scene_folder(source, with_materials=True)
        notes = export_scenes(rooms, to, out, asked)
        left_out = notes.left_out
        for note in (*notes.changed, *left_out):
            typer.echo(f"Note: {note}", err=True)
    typer.echo(f"Wrote {options.rooms_in_words(len(rooms))} to {out}")
    if strict and left_out:
        raise typer.Exit(options.LEFT_OUT)
