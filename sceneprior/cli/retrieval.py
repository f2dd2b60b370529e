"""The command that puts CAD models into rooms; what it needs it imports when called."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.cli.options import OverwriteOption, RendererOption


def retrieve(
    scenes: Annotated[Path, typer.Option(help="Folder of scene JSONs, with their GLBs.")],
    models: Annotated[Path, typer.Option(help="3D-FUTURE-model, or a folder like it.")],
    out: Annotated[Path, typer.Option(help="Folder for the scenes with CAD models.")],
    cache: Annotated[
        Path | None,
        typer.Option(help="Folder for the models' points (default: ~/.cache/sceneprior)."),
    ] = None,
    overwrite: OverwriteOption = False,
    renderer: RendererOption = "auto",
) -> None:
    """Exchange every object for the most similar CAD model of its class."""
    from rich.console import Console
    from rich.progress import track

    from sceneprior.evaluation.metrics.contents import common_label_set
    from sceneprior.files import write_json
    from sceneprior.generation.cad_models import default_cache, open_models
    from sceneprior.generation.export import check_free, load_scene_folder, write_scenes
    from sceneprior.generation.retrieve import retrieval_report, retrieve_all
    from sceneprior.offscreen import open_renderer

    check_free(out, overwrite)
    console = Console(stderr=True)
    rooms = load_scene_folder(scenes)
    cad_models = open_models(
        models, common_label_set(rooms), cache or default_cache(),
        track=lambda ids: track(ids, "Reading models", console=console, transient=True),
    )  # fmt: skip
    chosen = retrieve_all(rooms, cad_models)
    made = list(track(chosen, "Choosing models", total=len(rooms), console=console))
    report = retrieval_report(made, cad_models)
    write_scenes(made, out, open_renderer(renderer), overwrite)
    write_json(out / "retrieval.json", report)
    typer.echo(f"Gave {report['objects_with_a_model']} of {report['objects']} objects a model")
    if report["classes_without_models"]:
        kept = ", ".join(report["classes_without_models"])
        typer.echo(f"No model of these classes, so objects keep their own meshes: {kept}")
    if report["broken_models"]:
        typer.echo(f"{len(report['broken_models'])} models are broken; see retrieval.json")
    typer.echo(f"Wrote {len(made)} rooms to {out}")
