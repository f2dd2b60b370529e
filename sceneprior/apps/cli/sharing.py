"""Commands to share priors and rooms: pack, priors and export."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.apps.cli import options
from sceneprior.core.errors import InputError


def pack(
    run: Annotated[Path, typer.Argument(help="Folder of a run that `fit` made.")],
    out: Annotated[Path, typer.Option(help="The file to write, such as bedroom.prior.")],
    about: Annotated[
        Path | None,
        typer.Option(help="Markdown file on the data, their authors and licence, for the card."),
    ] = None,
    scores: Annotated[
        Path | None, typer.Option(help="Scores for the card (default: RUN/scores.json).")
    ] = None,
    latents: Annotated[
        bool, typer.Option("--latents", help="Keep the latents and ids of the training rooms.")
    ] = False,
    half: Annotated[
        bool, typer.Option("--half", help="Store large tensors in half precision.")
    ] = False,
    overwrite: options.Overwrite = False,
) -> None:
    """Write a trained run to one file for sharing: weights, settings, a card; no pickle."""
    from sceneprior.apps.config import load_any_run, run_config
    from sceneprior.apps.priors.card import model_card
    from sceneprior.apps.priors.packed import pack as packed_of
    from sceneprior.apps.priors.packed import write_packed
    from sceneprior.core.files import read_json
    from sceneprior.lifted.config import SAMPLER
    from sceneprior.paper.prior import TrainedPrior

    if out.exists() and (out.is_dir() or not overwrite):
        raise InputError(f"{out} already exists; name another file, or add --overwrite.")
    found = scores or run / "scores.json"
    measured = read_json(found) if scores is not None or found.is_file() else None
    if about is not None and not about.is_file():  # devices and pipes may be endless
        raise InputError(f"{about} cannot be read: it is missing or not a regular file.")
    stated = None if about is None else about.read_text(errors="replace")
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
    """List the priors that the package ships, or print the card of one prior."""
    from sceneprior.apps.priors.packed import find_prior, is_packed, read_packed, shipped_priors

    if name is not None:
        path = find_prior(name)
        if not is_packed(path):
            raise InputError(f"{name} is a run, which has no card; `sceneprior pack` writes one.")
        typer.echo(read_packed(path).card, nl=False)
        return
    for known, path in shipped_priors().items():
        packed = read_packed(path)
        typer.echo(
            f"{known:<20} {path.stat().st_size / 1e6:.1f} MB, {packed.said.settings['label_set']}, "
            f"{packed.said.training_rooms} training rooms"
        )


def export(
    source: Annotated[
        Path, typer.Argument(help="Folder of scenes, or of box lists for `--to scenes`.")
    ],
    to: Annotated[
        str,
        typer.Option(
            help="Format: mujoco, usd, habitat, sceneeval, obj, atiss, threed-front; or scenes."
        ),
    ],
    out: Annotated[Path, typer.Option(help="Folder to write to.")],
    label_set: Annotated[
        str | None, typer.Option(help="Label set of box lists, such as front3d_bedroom.")
    ] = None,
    classes: Annotated[
        str | None,
        typer.Option(help="Names of the columns of box lists (default: the label set's)."),
    ] = None,
    sizes: Annotated[
        str | None,
        typer.Option(help="Extents in box lists: half, as ATISS writes them (default), or full."),
    ] = None,
    shell: options.Shell = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Export scenes to another format, or convert box lists, such as ATISS's, to scenes.

    For simulators, walls are added unless --shell says otherwise, and objects are moved until they
    stand and do not overlap.
    """
    from sceneprior.apps.rooms import write_scenes
    from sceneprior.core.files import check_free
    from sceneprior.interchange.box_lists import read_box_lists
    from sceneprior.interchange.export import export_scenes
    from sceneprior.render.scene_files import load_scene_folder

    check_free(out, overwrite)
    if to == "scenes":
        if label_set is None:
            raise InputError("--to scenes needs --label-set, the label set of the box lists.")
        rooms = read_box_lists(source, label_set, classes, sizes or "half")
        write_scenes(rooms, out)
    else:
        if (label_set, classes, sizes) != (None, None, None):
            raise InputError("--label-set, --classes and --sizes apply only with --to scenes.")
        rooms = load_scene_folder(source, with_materials=True)
        asked = None if shell is None else options.checked_shell(shell)
        for note in export_scenes(rooms, to, out, asked):
            typer.echo(f"Note: {note}", err=True)
    typer.echo(f"Wrote {options.rooms_in_words(len(rooms))} to {out}")
