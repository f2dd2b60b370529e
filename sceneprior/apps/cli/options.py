"""Options that several commands share."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sceneprior.core.errors import InputError
from sceneprior.core.seeds import LARGEST_SEED

if TYPE_CHECKING:
    from sceneprior.core.shell import ShellName

RendererOption = Annotated[
    str, typer.Option(help="Renderer of the pictures: auto, pyrender or software (without GL).")
]
RunOption = Annotated[
    str,
    typer.Option(
        help="The trained prior: the folder of a run that `fit` made, a packed prior, the name of "
        "a shipped one (see `priors`), or hf://OWNER/NAME."
    ),
]
DistributionOption = Annotated[
    str | None,
    typer.Option(
        help="Distribution that new rooms are drawn from: sampler, paper, or kernel, which gives "
        "near copies of training rooms (default: the config's)."
    ),
]
CountOption = Annotated[int, typer.Option("-n", "--count", min=1, help="Number of rooms to make.")]
SeedOption = Annotated[
    int,
    typer.Option(
        min=0, max=LARGEST_SEED, help="Seed of all random choices: the same seed, the same result."
    ),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Replace existing files.")]
ShellOption = Annotated[
    str | None,
    typer.Option(
        help="Parts of the room itself to write: walls (with floor and ceiling), floor, or none."
    ),
]
InceptionOption = Annotated[
    Path | None, typer.Option(help="The file inception-2015-12-05.pt (TorchScript), for FID.")
]
AcceleratorOption = Annotated[
    str, typer.Option(help="Device to train on: cpu, gpu or auto (Lightning).")
]
ScenesOption = Annotated[
    Path | None, typer.Option(help="A folder of scene JSONs of any method, in place of --run.")
]
MODELS_HELP = "a 3D-FUTURE-model folder, a folder like it, or shards."
CacheOption = Annotated[
    Path | None,
    typer.Option(help="Folder that keeps the CAD models' points (default: ~/.cache/sceneprior)."),
]


def result_file(run: str, out: Path | None, name: str) -> Path:
    """The file of a run's results: `out` if given, else `name` in the run's folder."""
    from sceneprior.apps.priors.where import find_prior

    if out is not None:
        return checked_target(out)
    folder = find_prior(run)
    if folder != Path(run) or not folder.is_dir():
        raise InputError(f"{run} is not a folder that {name} could go to; name a file with --out.")
    return checked_target(folder / name)


def checked_shell(shell: str) -> "ShellName":
    """Check the value of `--shell`."""
    from sceneprior.core.shell import SHELLS

    for known in SHELLS:
        if shell == known:
            return known
    raise InputError(f"--shell {shell} is not known; choose from {', '.join(SHELLS)}.")


def checked_target(target: Path) -> Path:
    """Check, before the work begins, that a file can be written; returns it."""
    from sceneprior.core.files import check_writable

    if target.is_dir():
        raise InputError(f"{target} is a folder; name a file with --out.")
    check_writable(target)
    return target
