"""Commands that make, change and view rooms; each imports its dependencies when called.

Pictures are rendered by the z-buffer, because without a GPU, GL is slower and takes a second to
start.
"""

import threading
from pathlib import Path
from typing import Annotated, Any

import typer

from sceneprior.apps.cli import options
from sceneprior.apps.cli.options import option
from sceneprior.core.errors import InputError
from sceneprior.core.files import check_free

MOST_TOLD = 5
"""Maximum number of broken models, or of empty rooms, that a command names."""
_END_HELP = "a training room's id, seed:7, or a latent in a file: scenes/latents.npz:seed0_0003."


@options.with_request
def synthesize(
    run: options.Run,
    out: Annotated[Path, option("Folder for the scenes.")],
    count: options.Count = 16,
    seed: options.Seed = 0,
    distribution: options.Distribution = None,
    asked: Any = None,
    cad: options.Cad = False,
    html: Annotated[
        bool, option("Also write rooms.html, one page of 3D models.", "--html")
    ] = False,
    shell: options.Shell = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Generate rooms: JSON, GLB and a top-down PNG each, and latents if the method has them.

    Without --shell, GLBs hold furniture only. Pictures of rooms with doors or windows show walls.
    """
    check_free(out, overwrite)  # before imports that take seconds
    from sceneprior.apps.api import load
    from sceneprior.apps.rooms import PAGE_FILE, writing_scenes
    from sceneprior.evaluation.page import write_rooms_page

    drawn = options.checked_shell(shell or "none")
    prior = load(run)
    with writing_scenes(out, drawn, html) as (write, scenes):
        scenes += prior.sample(count, seed, distribution, **asked, cad=cad, then=write)
    status = options.note_unmet(scenes)
    origin = distribution or prior.distribution
    if html:
        told = f"run {Path(run).resolve().name} · seed {seed} · from: {origin}"
        write_rooms_page(out / PAGE_FILE, scenes, title="New rooms", subtitle=told, shell=drawn)
    typer.echo(f"Wrote {options.rooms_in_words(count)} to {out} (from: {origin})")
    if empty := [scene.name for scene in scenes if not scene.objects]:
        more = f" and {len(empty) - MOST_TOLD} more" * (len(empty) > MOST_TOLD)
        typer.echo(
            f"Note: {len(empty)} of {count} rooms are empty (no object): "
            f"{', '.join(empty[:MOST_TOLD])}{more}. Train longer, or on more rooms.",
            err=True,
        )
    raise typer.Exit(status)


def interpolate(
    run: options.Run,
    start: Annotated[str, option(f"First room: {_END_HELP}", "--from")],
    end: Annotated[str, option("Last room, named like the first one.", "--to")],
    out: Annotated[Path, option("Folder for the rooms and pictures.")],
    steps: Annotated[int, option("Rooms, both ends included.", min=2, max=1000)] = 9,
    overwrite: options.Overwrite = False,
) -> None:
    """Interpolate between two rooms on the sphere: rooms, a strip and an animation."""
    check_free(out, overwrite)  # before imports that take seconds
    from sceneprior.apps.api import load
    from sceneprior.apps.rooms import write_scenes
    from sceneprior.paper.interpolate import write_pictures

    prior = load(run)
    scenes = prior.interpolate(start, end, steps)
    write_scenes(scenes, out)
    write_pictures(prior.with_latents, scenes, out)
    typer.echo(f"Wrote {steps} rooms, strip.png and animation.gif to {out}")


@options.with_request
def complete(
    run: options.Run,
    given: Annotated[Path, option("Scene JSON of the given objects.")],
    out: Annotated[Path, option("Folder for the completed rooms.")],
    count: options.Count = 4,
    seed: options.Seed = 0,
    classes: Annotated[
        str | None, option("Classes of the objects to add: double_bed,nightstand.")
    ] = None,
    asked: Any = None,
    cad: options.Cad = False,
    shell: options.Shell = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Complete a room, given some objects and optionally the floor.

    A requested floor, door, window or ceiling replaces the scene's; requested objects are added to
    the scene's. Without --shell, GLBs hold furniture only.
    """
    check_free(out, overwrite)  # before imports that take seconds
    from dataclasses import replace

    from sceneprior.apps.api import load
    from sceneprior.apps.rooms import writing_scenes
    from sceneprior.render.scene_files import load_scene

    drawn = options.checked_shell(shell or "none")
    scene = load_scene(given, with_materials=True)
    scene = replace(scene, objects=(*scene.objects, *asked.pop("objects", ())))
    wanted = None if classes is None else [label.strip() for label in classes.split(",")]
    prior = load(run)
    with writing_scenes(out, drawn) as (write, scenes):
        scenes += prior.complete(scene, count, seed, wanted, **asked, cad=cad, then=write)
    status = options.note_unmet(scenes)
    given_objects = f"{len(scene.objects)} given object{'s' * (len(scene.objects) != 1)}"
    typer.echo(f"Wrote {options.rooms_in_words(count)} around {given_objects} to {out}")
    for room in scenes:
        if lacking := room.extra.get("no_place"):
            typer.echo(f"Note: {room.name} has no place for {', '.join(lacking)}.", err=True)
    raise typer.Exit(status)


def reconstruct(
    run: options.Run,
    out: Annotated[Path, option("Folder for the rooms.")],
    shards: Annotated[Path | None, option("Shards with the images.")] = None,
    room: Annotated[str | None, option("Id of a room of the shards.")] = None,
    view: Annotated[int, option("Index of the room's view, from 0.", min=0)] = 0,
    split: Annotated[
        str | None, option("Split of which to use one view per room: train or test.")
    ] = None,
    limit: options.Limit = None,
    mask: Annotated[
        Path | None, option("Masks of your own image: a PNG of ids, or COCO's JSON.")
    ] = None,
    classes: Annotated[Path | None, option("Classes of the PNG's ids, as CSV or JSON.")] = None,
    intrinsics: Annotated[
        str | None, option("Intrinsics: fov=73, 35mm=26, fx,fy,cx,cy or a JSON file.")
    ] = None,
    pose: Annotated[Path | None, option("JSON of your camera's pose.")] = None,
    camera_height: Annotated[
        float | None,
        option("Height of your camera in m, without --pose (default: tries several).", min=0.1),
    ] = None,
    gravity: Annotated[
        str | None, option("Direction of gravity in your camera's axes, without --pose: x,y,z.")
    ] = None,
    fit: options.Fit = "objects",
    restarts: options.Restarts = 1,
    seed: options.Seed = 0,
    overwrite: options.Overwrite = False,
) -> None:
    """Reconstruct rooms from the instance masks of single images: JSON, GLB and pictures."""
    from sceneprior.apps.api import load
    from sceneprior.apps.reconstruction.own_image import read_own_image
    from sceneprior.apps.reconstruction.reconstruct import (
        OBJECTS,
        write_page,
        write_reconstructions,
    )
    from sceneprior.core.boxes import QUARTERS
    from sceneprior.core.views import image_from_shards, images_of_split

    ways = [mask is not None, room is not None, split is not None]
    if sum(ways) != 1 or (shards is None) != (mask is not None):
        raise InputError(
            "Say what to reconstruct from, in exactly one way: --shards with --room (and --view); "
            "--shards with --split; or --mask with --intrinsics (and --classes)."
        )
    of_mask = (classes, intrinsics, pose, camera_height, gravity)
    if mask is None and any(given is not None for given in of_mask):
        raise InputError(
            "--classes, --intrinsics, --pose, --camera-height and --gravity belong to --mask."
        )
    if pose is not None and not (camera_height is None and gravity is None):
        raise InputError(
            "--pose already gives the height and the tilt of the camera; leave out --camera-height "
            "and --gravity."
        )
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


def retrieve(
    scenes: Annotated[Path, option("Folder of scene JSONs, with their GLBs.")],
    out: Annotated[Path, option("Folder for the scenes with CAD models.")],
    models: Annotated[
        Path | None, option(f"CAD models: {options.MODELS_HELP} {options.OWN_HELP}")
    ] = None,
    cache: options.Cache = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Replace every object by the most similar CAD model of its class."""
    check_free(out, overwrite)  # before imports that take seconds
    from sceneprior.apps.retrieval.cad_models import made_models, open_models
    from sceneprior.apps.retrieval.retrieve import retrieval_report, retrieve_all
    from sceneprior.apps.rooms import writing_scenes
    from sceneprior.core.files import write_json
    from sceneprior.evaluation.metrics.contents import common_label_set
    from sceneprior.render.scene_files import check_names, load_scene_folder

    rooms = load_scene_folder(scenes)
    cad_models = made_models()
    if models is not None:
        cad_models = open_models(models, common_label_set(rooms), cache)
    check_names(rooms)
    with writing_scenes(out) as (write, made):
        made += retrieve_all(rooms, cad_models, then=write)
    report = retrieval_report(made, cad_models)
    write_json(out / "retrieval.json", report)
    typer.echo(f"Gave {report['objects_with_a_model']} of {report['objects']} objects a model")
    if report["classes_without_models"]:
        kept = ", ".join(report["classes_without_models"])
        typer.echo(f"No model of these classes, so objects keep their own meshes: {kept}")
    broken = report["broken_models"]
    if broken:
        typer.echo(f"{len(broken)} models are broken; see retrieval.json")
    for reason in [*broken.values()][:MOST_TOLD]:
        typer.echo(f"Note: {reason}.", err=True)
    typer.echo(f"Wrote {options.rooms_in_words(len(made))} to {out}")


@options.with_request
def view(
    where: Annotated[
        str, typer.Argument(metavar="RUN_OR_SCENES", help="A run, or a folder of scenes.")
    ],
    models: Annotated[
        Path | None,
        option(f"Models that the page may show: {options.MODELS_HELP} {options.OWN_HELP}"),
    ] = None,
    asked: Any = None,
    shell: options.Shell = None,
    host: Annotated[
        str, option("Address to serve on; 0.0.0.0 opens the page to your network.")
    ] = "127.0.0.1",
    port: Annotated[int, option("Port to serve on.", min=1, max=65535)] = 8080,
    cache: options.Cache = None,
) -> None:
    """View rooms in the browser, request new ones, and explore the latent space of a run.

    Ctrl-C ends it. The first room fulfils the request given by the options, and is shown with walls
    unless --shell says otherwise.
    """
    from sceneprior.apps.viewer.server import check_can_serve, serving

    check_can_serve(host, port)  # before seconds are spent on loading
    drawn = options.checked_shell(shell or "walls")
    from sceneprior.apps.api import load
    from sceneprior.apps.retrieval.cad_models import open_models
    from sceneprior.apps.sample import with_floor_of_file
    from sceneprior.apps.viewer.explorer import Explorer
    from sceneprior.apps.viewer.panel import open_page
    from sceneprior.apps.viewer.shown import Folder
    from sceneprior.render.scene_files import load_scene_folder

    folder = Path(where)
    is_folder = folder.is_dir() and not (folder / "config.yaml").is_file()
    if asked and is_folder:
        raise InputError(
            f"{where} holds scenes, which are shown as they are; a request needs a prior."
        )
    try:
        source = Folder(load_scene_folder(folder)) if is_folder else Explorer(load(where))
        bank = None if models is None else open_models(models, source.label_set, cache)
        with serving(host, port) as server:
            open_page(server, source, folder.name, bank, with_floor_of_file(asked), drawn)
            typer.echo(f"Open http://localhost:{port} in a browser. Ctrl-C ends it.")
            threading.Event().wait()
    except KeyboardInterrupt:
        typer.echo("\nStopped: the page is closed.")
