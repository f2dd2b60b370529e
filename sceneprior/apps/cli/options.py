"""Options that several commands share, and what these make of their values."""

import functools
import inspect
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from sceneprior.core.errors import InputError
from sceneprior.core.parallel import on_workers
from sceneprior.core.repeatable import LARGEST_SEED

if TYPE_CHECKING:
    from sceneprior.core.scene import Scene
    from sceneprior.core.shell import ShellName


LEFT_OUT = 3
"""Exit status of a command that did its work but had to leave something out."""


def option(told: str, *names: str, **limits: Any) -> Any:
    """A typer option with its help text, and its names if they do not follow from the parameter."""
    return typer.Option(*names, help=told, **limits)


Run = Annotated[
    str,
    option(
        "The trained prior: the folder of a run that `fit` made, a packed prior, the name of "
        "a shipped one (see `priors`), or hf://OWNER/NAME."
    ),
]
Distribution = Annotated[
    str | None,
    option(
        "Distribution that new rooms are drawn from: sampler, paper, or kernel, which gives "
        "near copies of training rooms (default: the config's)."
    ),
]
Count = Annotated[int, option("Number of rooms to make.", "-n", "--count", min=1)]
Seed = Annotated[
    int,
    option("Seed of all random choices: the same seed, the same result.", min=0, max=LARGEST_SEED),
]
Overwrite = Annotated[bool, option("Replace existing files.", "--overwrite")]
Shell = Annotated[
    str | None,
    option("Parts of the room itself to write: walls (with floor and ceiling), floor, or none."),
]
Inception = Annotated[
    Path | None, option("The file inception-2015-12-05.pt (TorchScript), for FID.")
]
Accelerator = Annotated[str | None, option("Device: cpu, gpu or auto (default: the config's).")]


def _is_folder(scenes: Path | None) -> Path | None:
    if scenes is not None and scenes.is_file():
        raise InputError(
            f"--scenes {scenes} is a file, but a folder of scenes is needed; give {scenes.parent}, "
            "or copy the file to a folder of its own."
        )
    return scenes


Scenes = Annotated[
    Path | None,
    option("A folder of scene JSONs of any method, in place of --run.", callback=_is_folder),
]
Fit = Annotated[str, option("Fit: objects (one by one), or paper (one latent, in 1,000 steps).")]
Limit = Annotated[int | None, option("Number of rooms (default: all).", min=1)]
Restarts = Annotated[int, option("Latents to fit to each image; the best is kept.", min=1)]
MODELS_HELP = (
    "a 3D-FUTURE-model folder, shards, or a folder with GLBs or OBJs in sub-folders by class."
)
OWN_HELP = "Default: the package's own furniture."
Cad = Annotated[
    bool, option("Replace decoded meshes by models of the package's own furniture.", "--cad")
]
Cache = Annotated[
    Path | None, option("Folder that keeps the CAD models' points (default: ~/.cache/sceneprior).")
]


def request_of(
    floor: Annotated[
        str | None,
        option(
            "Floor of the rooms: 4x3 (metres along x and z), corners '0,0 5,0 5,3 2,3 2,5 "
            "0,5', or a file with a floor (FILE, or FILE:ROOM of a 3D-FRONT house); samplers only."
        ),
    ] = None,
    openings: Annotated[
        str | None, option("Doors and windows: door,window@north,door@south:1.5 (samplers only).")
    ] = None,
    ceiling: Annotated[
        float | None, option("Height of the ceiling in metres (samplers only).")
    ] = None,
    want: Annotated[
        str | None,
        option(
            "Wishes: 'a double bed and two nightstands beside it', or numbers of objects: "
            "'nightstand: 2, desk: 0' (samplers only)."
        ),
    ] = None,
    request: Annotated[
        Path | None, option("JSON of a request: floor, openings, wishes (samplers only).")
    ] = None,
) -> dict[str, Any]:
    """The arguments of `Prior.sample` from the options of a request and its file."""
    asked = {"floor": floor, "openings": openings, "ceiling_m": ceiling, "want": want}
    if request is None and not any(value is not None for value in asked.values()):
        return {}
    from sceneprior.apps.sample import load_request, merged

    return merged(asked, {} if request is None else load_request(request))


def with_request(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of a request in place of its parameter `asked`, which it is
    called with: the arguments that `request_of` makes of them."""
    shared = inspect.signature(request_of).parameters
    own = inspect.signature(command, eval_str=True)
    parameters = list(own.parameters.values())
    at = list(own.parameters).index("asked")
    parameters[at : at + 1] = shared.values()

    @functools.wraps(command)
    def with_options(**values: Any) -> None:
        asked = request_of(**{name: values.pop(name) for name in shared})
        command(**values, asked=asked)

    with_options.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    return with_options


def with_workers(command: Callable[..., None], usual: int | None = 1) -> Callable[..., None]:
    """Give a command the options `--workers`, `usual` if not given (None is one per core), and
    `--scheduler`; its `run_tasks` works there."""
    default = "all cores" if usual is None else "this process"
    count = Annotated[int | None, option(f"Processes on this machine (default: {default}).", min=1)]
    dask = Annotated[
        str | None, option("Work on a Dask cluster instead: tcp://HOST:8786 (docs/cluster.md).")
    ]
    own = inspect.signature(command, eval_str=True)
    shared = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=kind)
        for name, kind in (("workers", count), ("scheduler", dask))
    ]

    @functools.wraps(command)
    def with_options(workers: int | None, scheduler: str | None, **values: Any) -> None:
        with on_workers(workers or usual, scheduler):
            command(**values)

    parameters = [*own.parameters.values(), *shared]
    with_options.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    return with_options


def rooms_in_words(count: int) -> str:
    """The number of rooms: `1 room`, `2 rooms`."""
    return "1 room" if count == 1 else f"{count} rooms"


def note_unmet(scenes: Sequence["Scene"]) -> int:
    """Print how many wishes hold, and those that each room does not fulfil; the exit status of the
    command, `LEFT_OUT` if rooms lack something that the request requires."""
    wishes = [each for room in scenes for each in room.extra.get("wishes", [])]
    held = sum(each["holds"] for each in wishes)
    if wishes:
        checked = ", ".join(dict.fromkeys(each["wish"] for each in wishes))
        start = "All wishes" if held == len(wishes) else f"{held} of {len(wishes)} wishes"
        typer.echo(f"{start} hold in {rooms_in_words(len(scenes))}: {checked}")
    for room in scenes:
        unmet = [each["wish"] for each in room.extra.get("wishes", []) if not each["holds"]]
        if unmet:
            typer.echo(f"Note: {room.name} does not fulfil: {', '.join(unmet)}.", err=True)
        if remarks := room.extra.get("remarks"):
            typer.echo(f"Note: in {room.name}, {'; '.join(remarks)}.", err=True)
    if lacks := [room.extra["lacks"] for room in scenes if "lacks" in room.extra]:
        said = f"{len(lacks)} of {rooms_in_words(len(scenes))} could not be drawn as requested"
        typer.echo(f"Note: {said}: {lacks[0]}", err=True)
    return LEFT_OUT if lacks else 0


def result_file(run: str, out: Path | None, name: str) -> Path:
    """The file of a run's results: `out` if given, else `name` in the run's folder."""
    from sceneprior.apps.priors.packed import find_prior

    if out is not None:
        return checked_target(out)
    folder = find_prior(run)
    if folder != Path(run) or not folder.is_dir():
        raise InputError(
            f"{run} is not a folder, so {name} cannot go there; name a file with --out."
        )
    return checked_target(folder / name)


def checked_target(target: Path) -> Path:
    """Check, before the work begins, that a file can be written; return its path."""
    from sceneprior.core.files import check_writable

    if target.is_dir():
        raise InputError(f"{target} is a folder; name a file with --out.")
    check_writable(target)
    return target


def checked_shell(shell: str) -> "ShellName":
    """Check the value of `--shell`."""
    from sceneprior.core.shell import SHELLS

    for known in SHELLS:
        if shell == known:
            return known
    raise InputError(f"--shell {shell} is not known; choose from {', '.join(SHELLS)}.")
