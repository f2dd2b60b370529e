"""The runs of a comparison, and the rows that each of them has in the tables."""

import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.comparison import (
    EVERY,
    TASKS,
    Comparison,
    Method,
    RoomComparison,
    Rooms,
    ViewComparison,
)
from sceneprior.apps.reconstruction.reconstruct import OBJECTS
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.core.settings import check_settings, read_settings
from sceneprior.lifted.config import SAMPLER, LiftedConfig
from sceneprior.paper.config import PaperConfig
from sceneprior.training.method import RunConfig

PAPER, LIFTED = "the paper's method and variations of it", "the lifted method"
LIFTED_BOXES = "the paper's network and latents trained on lifted boxes"
GIVEN = "scenes as given, which were made elsewhere"
LATENTS, FIT = "latents", "fit"
ROWS = {
    (LATENTS, False): ("Paper's method", "", PAPER),
    (LATENTS, True): (
        "Paper's sphere, trained on lifted boxes", "trained on lifted boxes", LIFTED_BOXES,
    ),
    (SAMPLER, True): ("Lifted method: sampler", "sampler of the lifted method", LIFTED),
    (FIT, False): ("Paper: fit of a latent", "fit of a latent", PAPER),
    (FIT, True): (
        "Fit of a latent, trained on lifted boxes", "fit of a latent, trained on lifted boxes",
        LIFTED_BOXES,
    ),
    (OBJECTS, False): ("Object by object, by the paper's prior", "object by object", LIFTED),
    (OBJECTS, True): ("Object by object", "object by object", LIFTED),
}  # fmt: skip
"""Title of a row, text to append to a title of the user's, and the method's name in captions, by
the way in which rooms are made and by whether the run is of the lifted method."""


@dataclass(frozen=True)
class Run:
    """One training of a method, on one kind of rooms, with one seed."""

    rooms: str
    method: str
    seed: int
    config: str
    settings: tuple[str, ...]
    """Changes to the config, for `fit --set`."""
    folder: Path

    @property
    def run_config(self) -> RunConfig:
        """The settings of the run's training."""
        return load_config(self.config, self.settings)

    @property
    def title(self) -> str:
        return f"{self.rooms}, {self.method}, seed {self.seed}"


@dataclass(frozen=True)
class Variant:
    """One way in which a run makes rooms or reconstructions; each has a command and a table row."""

    name: str | None
    """Value of `--distribution` or `--fit`; None leaves the option out."""
    title: str
    """Title of the row; empty if neither the comparison nor a config gives one."""
    made_by: str
    """Name of the method in captions."""
    result: Path
    """File of the variant's scores."""


def load_comparison(name: str) -> Comparison:
    """Read a comparison and check the settings of each of its runs."""
    path, data = read_settings(name)
    task = data.get("task", "new_rooms")
    if not isinstance(task, str) or task not in TASKS:
        raise ConfigError(f"{path}: no task is called '{task}'; choose from {', '.join(TASKS)}.")
    comparison = check_settings(TASKS[task], data, str(path))
    rows: dict[tuple[str, str], str] = {}
    for run in runs_of(comparison, Path()):
        for variant in variants_of(comparison, run):
            if not (title := variant.title):
                raise ConfigError(
                    f"{path}: methods.{run.method} has no title; only the paper's and the "
                    "lifted method are named by their configs."
                )
            if (other := rows.setdefault((run.rooms, title), run.method)) != run.method:
                raise ConfigError(
                    f"{path}: the title '{title}' is given twice; a title names a row, so give "
                    f"methods.{other} or methods.{run.method} another `title`."
                )
    return comparison


def runs_of(comparison: Comparison, out: Path) -> list[Run]:
    """All runs, seed by seed, so that a comparison stopped early is complete for fewer seeds."""
    runs = []
    for seed, (key, rooms), (name, method) in product(
        comparison.seeds, comparison.rooms.items(), comparison.methods.items()
    ):
        changes = (*method.set.get(EVERY, ()), *method.set.get(key, ()))
        settings = (*_of_rooms(rooms, method), *changes, f"seed={seed}")
        config = method.config or rooms.config
        runs.append(Run(key, name, seed, config, settings, out / key / name / f"seed{seed}"))
    return runs


def part_of(
    comparison: Comparison,
    out: Path,
    methods: str | None = None,
    rooms: str | None = None,
    seeds: str | None = None,
) -> list[Run]:
    """The runs of the given methods, kinds of rooms and seeds, each as `a,b`; None means all."""
    known = {
        "method": (methods, list(comparison.methods)),
        "kind of rooms": (rooms, list(comparison.rooms)),
        "seed": (seeds, [str(seed) for seed in comparison.seeds]),
    }
    chosen = {}
    for what, (given, names) in known.items():
        asked = names if given is None else [name.strip() for name in given.split(",")]
        chosen[what] = asked = [name for name in asked if name]
        for name in asked:
            if name not in names:
                raise InputError(
                    f"No {what} '{name}' in this comparison; it has {', '.join(names)}."
                )
        if not asked:
            raise InputError(f"No {what} was named; the comparison has {', '.join(names)}.")
    return [
        run
        for run in runs_of(comparison, out)
        if run.method in chosen["method"]
        and run.rooms in chosen["kind of rooms"]
        and str(run.seed) in chosen["seed"]
    ]


def _of_rooms(rooms: Rooms, method: Method) -> list[str]:
    """Settings that a method takes from its rooms: their changes to the config that both share, or
    a few values for a config of its own."""
    if method.config is None:
        return list(rooms.set)
    shared, own = read_settings(rooms.config, rooms.set)[1], read_settings(method.config)[1]
    keys = ["label_set", "data.shards"]
    if _value(own, "model.max_objects") is not None:
        keys.append("model.max_objects")
    values = {key: _value(shared, key) for key in keys}
    # Values are quoted as JSON, which is valid YAML, so that a folder called 2024 stays a string.
    return [f"{key}={json.dumps(v)}" for key, v in values.items() if v is not None]


def _value(data: Any, key: str) -> Any:
    for part in key.split("."):
        data = data.get(part) if isinstance(data, dict) else None
    return data


def shards_of(comparison: Comparison, rooms: str) -> Path:
    """The folder of shards that holds a kind of rooms."""
    kind = comparison.rooms[rooms]
    return Path(load_config(kind.config, kind.set).data.shards)


def variants_of(comparison: Comparison, run: Run) -> list[Variant]:
    """The variants of a run, in the order of their rows.

    A run that keeps the latents of training rooms has one variant per distribution or fit; its
    sampler, if it has one, comes first. Runs of other methods have a single variant.
    """
    title = comparison.methods[run.method].title
    config, views = run.run_config, isinstance(comparison, ViewComparison)
    names: tuple[str | None, ...] = (None,)
    if config.remembers_rooms and isinstance(comparison, ViewComparison):
        names = comparison.fits
    elif config.remembers_rooms and isinstance(comparison, RoomComparison):
        own = (None,) if getattr(config, "distribution", None) == SAMPLER else ()
        names = (*own, *comparison.distributions)
    found = []
    for name in names:
        way = name if not views else OBJECTS if name in (None, OBJECTS) else FIT
        plain, detail, made_by = made_by_run(config, way)
        row = plain if title is None else ", ".join(filter(None, (title, detail)))
        file = "scores.json" if name == names[0] else f"scores_{name}.json"
        found.append(Variant(name, row, made_by, run.folder / file))
    return found


def made_by_run(config: RunConfig, way: str | None = None) -> tuple[str, str, str]:
    """The entry of `ROWS` for a run and a way to make rooms: `OBJECTS`, `FIT`, or a distribution of
    new rooms (None: the run's default). Other methods are baselines, without a title."""
    if not isinstance(config, PaperConfig | LiftedConfig):
        return "", "", "baselines"
    way = way or config.distribution
    way = way if way in (SAMPLER, FIT, OBJECTS) else LATENTS
    return ROWS[way, isinstance(config, LiftedConfig)]
