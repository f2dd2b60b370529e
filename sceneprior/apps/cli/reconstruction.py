"""Commands that reconstruct rooms from single images; dependencies load when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.apps.cli import options

FitOption = Annotated[
    str, typer.Option(help="Fit: objects (one by one), or paper (one latent, in 1,000 steps).")
]
LimitOption = Annotated[int | None, typer.Option(min=1, help="Number of rooms (default: all).")]
RestartsOption = Annotated[
    int, typer.Option(min=1, help="Latents to fit to each image; the best is kept.")
]


def reconstruct(
    run: options.Run,
    out: Annotated[Path, typer.Option(help="Folder for the rooms.")],
    shards: Annotated[Path | None, typer.Option(help="Shards with the images.")] = None,
    room: Annotated[str | None, typer.Option(help="Id of a room of the shards.")] = None,
    view: Annotated[int, typer.Option(min=0, help="Index of the room's view, from 0.")] = 0,
    split: Annotated[
        str | None, typer.Option(help="Split of which to use one view per room: train or test.")
    ] = None,
    limit: LimitOption = None,
    mask: Annotated[
        Path | None, typer.Option(help="Masks of your own image: a PNG of ids, or COCO's JSON.")
    ] = None,
    classes: Annotated[
        Path | None, typer.Option(help="Classes of the PNG's ids, as CSV or JSON.")
    ] = None,
    intrinsics: Annotated[
        str | None, typer.Option(help="Intrinsics: fov=73, 35mm=26, fx,fy,cx,cy or a JSON file.")
    ] = None,
    pose: Annotated[Path | None, typer.Option(help="JSON of your camera's pose.")] = None,
    camera_height: Annotated[
        float | None,
        typer.Option(
            min=0.1, help="Height of your camera in m, without --pose (default: tries several)."
        ),
    ] = None,
    gravity: Annotated[
        str | None,
        typer.Option(help="Direction of gravity in your camera's axes, without --pose: x,y,z."),
    ] = None,
    fit: FitOption = "objects",
    restarts: RestartsOption = 1,
    seed: options.Seed = 0,
    overwrite: options.Overwrite = False,
) -> None:
    """Reconstruct rooms from the instance masks of single images: JSON, GLB and pictures."""
    from sceneprior.apps.api import load
    from sceneprior.apps.reconstruction.export import write_page, write_reconstructions
    from sceneprior.apps.reconstruction.own_image import read_own_image
    from sceneprior.apps.reconstruction.reconstruct import OBJECTS
    from sceneprior.core.boxes import QUARTERS
    from sceneprior.core.errors import InputError
    from sceneprior.core.files import check_free
    from sceneprior.core.views import image_from_shards, images_of_split

    ways = [mask is not None, room is not None, split is not None]
    if sum(ways) != 1 or (shards is None) != (mask is not None):
        raise InputError(
            "Say what to reconstruct from, in exactly one way: --shards with --room (and --view); "
            "--shards with --split; or --mask with --intrinsics (and --classes)."
        )
    if mask is None and any(given is not None for given in (classes, intrinsics, pose, gravity)):
        raise InputError("--classes, --intrinsics, --pose and --gravity belong to --mask.")
    if pose is not None and gravity is not None:
        raise InputError("--pose already gives the direction of gravity; leave out --gravity.")
    if (limit is not None and split is None) or (view and room is None):
        raise InputError("--limit belongs to --split, and --view to --room.")
    check_free(out, overwrite)
    prior = load(run)
    notes = []
    if shards is None:
        if mask is None or intrinsics is None:
            raise InputError("--mask needs --intrinsics and, for a PNG, --classes.")
        # Object-by-object fits do not depend on the side of the room at which the camera stands.
        sides = 1 if fit == OBJECTS else QUARTERS
        own = read_own_image(
            mask, classes, intrinsics, prior.label_set, pose, camera_height, sides, gravity
        )
        images, notes = list(own.images), [f"{note}." for note in own.notes]
    elif room is not None:
        images = [image_from_shards(shards, room, view)]
    else:
        images, blank = images_of_split(shards, split or "test", seed, limit)
        notes = [f"no view of room {name} shows an object; it is left out." for name in blank]
    for note in notes:
        typer.echo(f"Note: {note}", err=True)
    found = prior.reconstruct(images, fit, restarts)
    if mask is not None:  # one image with several candidate cameras: the best fit is kept
        found = [min(found, key=lambda one: one.score)]
        if len(images) > 1:
            height_m = found[0].image.eye_m[1]
            typer.echo(f"Note: a camera {height_m:g} m above the floor fits best.", err=True)
    taken_for = {pair for one in found for pair in one.taken_for.items()}
    for name, other in sorted(taken_for):
        typer.echo(
            f"Note: the run never generates the class {name}; a {other} is used instead.", err=True
        )
    write_reconstructions(found, out)
    if mask is not None:
        write_page(found[0], out)
    typer.echo(f"Wrote {options.rooms_in_words(len(found))} to {out}")


def eval_svr(
    shards: Annotated[Path, typer.Option(help="Shards with 3D ground truth.")],
    run: Annotated[str | None, typer.Option(help="Run to evaluate.")] = None,
    scenes: Annotated[
        Path | None, typer.Option(help="Scenes of `reconstruct` or `retrieve`, in place of --run.")
    ] = None,
    split: Annotated[str, typer.Option(help="Split: train, val or test.")] = "test",
    views: Annotated[int, typer.Option(min=1, help="Largest number of views per room.")] = 1,
    limit: LimitOption = None,
    out: Annotated[
        Path | None, typer.Option(help="JSON file (default: svr.json in RUN or SCENES).")
    ] = None,
    fit: FitOption = "objects",
    restarts: RestartsOption = 1,
    models: Annotated[
        Path | None,
        typer.Option(help=f"CAD models to put in place of the fits, too: {options.MODELS_HELP}"),
    ] = None,
    seed: options.Seed = 0,
) -> None:
    """Evaluate single-view reconstruction, with training rooms as baselines."""
    from sceneprior.apps.reconstruction.reconstruct import FitOptions
    from sceneprior.apps.reconstruction.score import (
        evaluate_run,
        evaluate_scenes,
        print_view_scores,
    )
    from sceneprior.core.errors import InputError
    from sceneprior.core.files import write_json

    if run is not None and scenes is None:
        chosen = FitOptions(fit, restarts)
        target = options.result_file(run, out, "svr.json")
        found = evaluate_run(run, shards, chosen, split, seed, views, limit, models)
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
