"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.errors import InputError

RendererOption = Annotated[
    str, typer.Option(help="auto, pyrender or software (needs no GL library).")
]
RunOption = Annotated[
    str,
    typer.Option(
        help="Folder of a run that `fit` made, a packed prior, the name of one (see `priors`), or "
        "hf://OWNER/NAME."
    ),
]
DistributionOption = Annotated[
    str | None,
    typer.Option(help="sampler, kernel, geodesic, gaussian or paper (default: the config's)."),
]
CheckpointOption = Annotated[
    str,
    typer.Option(help="final, or best: what generated best while training (samples.every)."),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
InceptionOption = Annotated[
    Path | None, typer.Option(help="inception-2015-12-05.pt (TorchScript), for FID proper.")
]
AcceleratorOption = Annotated[str, typer.Option(help="cpu, gpu or auto; Lightning's option.")]


def result_file(run: str, out: Path | None, name: str) -> Path:
    """Where a run's results go: into its folder unless told otherwise; an InputError where it has
    none."""
    from sceneprior.priors.where import find_prior

    if out is not None:
        return out
    folder = find_prior(run)
    if folder != Path(run) or not folder.is_dir():
        raise InputError(f"{run} is no folder to keep {name} in; name a file with --out.")
    return folder / name
