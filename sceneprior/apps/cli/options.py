"""Options that several commands share."""

from pathlib import Path
from typing import Annotated

import typer

from sceneprior.core.errors import InputError

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
    typer.Option(
        help="sampler, paper, or kernel, whose rooms are near copies of training rooms (default: "
        "the config's)."
    ),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]
InceptionOption = Annotated[
    Path | None, typer.Option(help="inception-2015-12-05.pt (TorchScript), for FID proper.")
]
AcceleratorOption = Annotated[str, typer.Option(help="cpu, gpu or auto; Lightning's option.")]


def result_file(run: str, out: Path | None, name: str) -> Path:
    """The file of a run's results: `out` if given, else `name` in the run's folder."""
    from sceneprior.apps.priors.where import find_prior

    if out is not None:
        return out
    folder = find_prior(run)
    if folder != Path(run) or not folder.is_dir():
        raise InputError(f"{run} is no folder to keep {name} in; name a file with --out.")
    return folder / name


def checked_target(target: Path) -> Path:
    """Check, before the work begins, that a file can be written; returns it."""
    from sceneprior.core.files import check_writable

    if target.is_dir():
        raise InputError(f"{target} is a folder; name a file with --out.")
    check_writable(target)
    return target
