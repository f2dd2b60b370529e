"""New rooms from a run of any method, and requests for them: arguments, JSON, and floors in other
files."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from sceneprior.apps.priors.packed import priors_that_draw
from sceneprior.core.classes import UnknownClassError
from sceneprior.core.errors import InputError
from sceneprior.core.files import read_json
from sceneprior.core.repeatable import check_seed, single_threaded
from sceneprior.core.scene import Scene
from sceneprior.lifted.drawing.draw import sample_scenes
from sceneprior.lifted.requests.request import RequestFile, RoomRequest
from sceneprior.lifted.trained import SAMPLER, TrainedLifted
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import decode_latents, draw_latents
from sceneprior.training.method import Trained, TrainedReconstructor

Then = Callable[[list[Scene], int], list[Scene]]
"""Function of a task's rooms and the number of the first one, such as one that writes them."""


@single_threaded()
def sample_rooms(
    trained: Trained,
    count: int,
    seed: int,
    distribution: str | None = None,
    request: RoomRequest | None = None,
    completes: bool = False,
    classes: Sequence[str] | None = None,
    with_models: Callable[[list[Scene]], list[Scene]] | None = None,
    rows: range | None = None,
) -> list[Scene]:
    """Sample new rooms from a run of any method, by its sampler or a distribution of latents.

    The same seed gives the same rooms; without a distribution, the run's default is used.

    Args:
        request: What the rooms must meet; only a sampler can.
        completes: Complete the room of the request, whose floor stays where it is, by the run's
            sampler, whatever its default.
        classes, with_models: See `sample_scenes`.
        rows: The rooms to return, of the `count`; None for all.

    Raises:
        InputError: the run cannot draw such rooms.
    """
    if isinstance(trained, TrainedReconstructor):
        raise InputError(
            f"`method: {trained.config.method}` reconstructs images and makes no new rooms; use "
            "`sceneprior reconstruct` or `eval-svr`, or a run of another method."
        )
    check_seed(seed)
    rows = range(count) if rows is None else rows
    names = [f"seed{seed}_{row:04d}" for row in rows]
    has_sampler = isinstance(trained, TrainedLifted) and trained.sampler is not None
    if completes:
        names = [f"complete_{row:02d}" for row in rows]
        distribution = SAMPLER if has_sampler else distribution
    if isinstance(trained, TrainedPrior) and (distribution or trained.distribution) == SAMPLER:
        if not isinstance(trained, TrainedLifted) or not has_sampler:
            raise InputError(
                "This run has no sampler, or its stage has not begun; leave out --distribution "
                f"{SAMPLER}, or train with a section `sampler` (`--config lifted/bedroom.yaml`)."
            )
        try:
            return sample_scenes(
                trained, names, seed, request, classes, completes, with_models, rows.start
            )
        except UnknownClassError as error:
            if not (shipped := priors_that_draw(error.label)):
                raise
            raise InputError(
                f"'{error.label}' is not a class of this prior; shipped priors that draw it: "
                f"{', '.join(shipped)} (--run {shipped[0]}). This one draws "
                f"{', '.join(error.known)}."
            ) from None
    if request is not None or classes is not None:
        others = "these rooms come from latents"
        if not isinstance(trained, TrainedPrior):
            others = f"`method: {trained.config.method}` has none"
        raise InputError(
            f"Floors, wishes and given objects need a sampler, but {others}; leave them out, or "
            "take a prior with a sampler."
        )
    if isinstance(trained, TrainedPrior):
        z = draw_latents(trained, count, seed, distribution)[rows.start : rows.stop]
        found = decode_latents(trained, z, names)
        return found if with_models is None else with_models(found)
    if distribution is not None:
        raise InputError(
            f"--distribution {distribution} chooses a distribution of latents, but `method: "
            f"{trained.config.method}` has no latents; leave the option out."
        )
    rooms = trained.prior.sample(count, seed)
    found = rooms.to_scenes(trained.config.label_set, names, rows.start)
    return found if with_models is None else with_models(found)


def load_request(path: str | Path) -> dict[str, Any]:
    """Read a request from JSON, as arguments for `prior.sample(4, **load_request(path))`.

    Raises:
        InputError: the file is no request.
    """
    data = read_json(Path(path))
    if not isinstance(data, dict):
        raise InputError(
            f"{path} is not a request, which docs/requests.md describes: expected a JSON object."
        )
    parts = RequestFile.of(str(path), **with_floor_of_file(data)).parts()
    own = {key: part for key, part in parts.items() if key in data}
    # A floor's file is only checked here, since options may add openings or a ceiling of their own.
    return own | ({"floor": data["floor"]} if isinstance(data.get("floor"), str) else {})


def request_of(asked: Mapping[str, Any]) -> RoomRequest | None:
    """The request of these parts, of which None is left out; None if there is no part.

    Raises:
        InputError: a part is invalid.
    """
    asked = with_floor_of_file({key: part for key, part in asked.items() if part is not None})
    return RoomRequest.of(**asked) if asked else None


def with_floor_of_file(asked: dict[str, Any]) -> dict[str, Any]:
    """Replace a file name given as the floor of a request by the floor in that file. Doors, windows
    and ceiling are also taken from the file, unless the request has its own.

    Raises:
        InputError: the file has no floor.
    """
    floor = asked.get("floor")
    named = isinstance(floor, str) and floor.partition(":")[0].endswith((".json", ".npz"))
    if not named and not isinstance(floor, Path):
        return asked
    from sceneprior.interchange.floors import read_floor_file  # imported here: files only

    found = read_floor_file(str(floor))
    own: dict[str, Any] = {"floor": found.outline_m}
    if asked.get("openings") is None:
        own["openings"] = found.openings
    if asked.get("ceiling_m") is None:
        own["ceiling_m"] = found.ceiling_m
    return {**asked, **own}


def merged(asked: dict[str, Any], file: dict[str, Any]) -> dict[str, Any]:
    """Merge the arguments of a request with those of a request's file.

    Raises:
        InputError: an argument is in both.
    """
    own = {key: value for key, value in asked.items() if value is not None}
    if both := sorted(own.keys() & file.keys()):
        raise InputError(
            f"Both the request's file and the options have {', '.join(both)}; leave one out."
        )
    return {**file, **own}
