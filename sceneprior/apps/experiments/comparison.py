"""Comparisons: their settings, the runs that these ask for, and the rows of a run in the tables."""

import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

from pydantic import Field, field_validator, model_validator

from sceneprior.apps.config import load_config
from sceneprior.apps.reconstruction.reconstruct import OBJECTS
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.core.ground_truth import known_in_3d
from sceneprior.core.repeatable import LARGEST_SEED
from sceneprior.core.settings import Section, check_settings, read_settings
from sceneprior.core.shards import iterate_rooms
from sceneprior.lifted.config import LiftedConfig
from sceneprior.lifted.trained import SAMPLER
from sceneprior.paper.config import PaperConfig
from sceneprior.training.method import RunConfig

EVERY = "every"
"""Key of `Method.set` for settings that apply to every kind of room."""
OF_SHARDS = "shards"
"""Value of `cad_models` that selects the CAD models of the training rooms."""


class Rooms(Section):
    """A kind of room to compare on."""

    config: str
    """Run config of the paper's or the lifted method; all methods use the rooms of this config."""
    set: tuple[str, ...] = Field((), strict=False)
    """Changes to the config as `section.key=value`, for example other shards."""
    title: str
    """Heading of the table of these rooms."""


class Method(Section):
    """One method of a comparison."""

    title: str | None = None
    """Title of the method's rows. None takes the title from the config (`ROWS`), which works
    only for the paper's and the lifted method. Variations of these need a title; the table appends
    the kind of supervision and the distribution."""
    config: str | None = None
    """The method's own run config; None takes the config of the rooms. Label set, shards, seed and
    `model.max_objects` (if the config has this key) come from the rooms in either case."""
    set: dict[str, list[str]] = Field(default_factory=dict)
    """Changes to the config as `section.key=value`, by kind of room; changes under `every` are
    applied first."""


class _Comparison(Section):
    """A comparison: every method is run on every kind of room with every seed."""

    seeds: tuple[int, ...] = Field(min_length=1, strict=False)
    """Seeds of training; each gives one run."""
    sampling_seed: int = Field(0, ge=0, le=LARGEST_SEED)
    """Seed of the generated rooms, or of the views to reconstruct, the same for every run."""
    rooms: dict[str, Rooms] = Field(min_length=1)
    methods: dict[str, Method] = Field(min_length=1)
    cad_models: str | None = None
    """CAD models of a second row of each method, in which every object is replaced by the most
    similar one: a folder, as for `retrieve --models`, or `shards` for the CAD models of the
    training rooms. Null leaves out these rows."""

    @field_validator("seeds")
    @classmethod
    def _each_once(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds) or min(seeds) < 0:
            raise ValueError("seeds must be distinct integers of at least 0")
        return seeds

    @model_validator(mode="after")
    def _names_are_clear(self) -> "_Comparison":
        titles = [rooms.title for rooms in self.rooms.values()]
        if twice := [title for title in titles if titles.count(title) > 1]:
            raise ValueError(f"the title '{twice[0]}' is given twice; a title names a table")
        known = ", ".join(self.rooms)
        for key, method in self.methods.items():
            if unlisted := sorted(set(method.set) - {EVERY, *self.rooms}):
                raise ValueError(
                    f"methods.{key}.set has '{unlisted[0]}'; expected {EVERY} or one of {known}"
                )
        return self

    def models(self, shards: Path) -> list[str]:
        """The option `--models` of the commands that score CAD models."""
        if self.cad_models is None:
            return []
        return ["--models", str(shards) if self.cad_models == OF_SHARDS else self.cad_models]


class RoomComparison(_Comparison):
    """Comparison of new rooms (the paper's Tables 1, 3 and 4), by `evaluate`."""

    command: ClassVar = "evaluate"
    option: ClassVar = "--distribution"

    task: Literal["new_rooms"] = "new_rooms"
    count: int | None = Field(None, ge=2)
    """Number of rooms that each run generates for its evaluation. None takes the number of training
    rooms, at which Frechet distances can be compared with those of the reference rows."""
    distributions: tuple[Literal["paper", "kernel"], ...] = Field(
        ("paper", "kernel"), min_length=1, strict=False
    )
    """Distributions of latents for evaluating priors that keep the latents of training rooms, one
    row each. Other methods are evaluated with their own distribution."""

    def variants(self, config: RunConfig) -> tuple[str | None, ...]:
        """Values of `option` for a run that keeps the latents of training rooms; None leaves the
        option out, which takes the run's sampler."""
        own = (None,) if getattr(config, "distribution", None) == SAMPLER else ()
        return (*own, *self.distributions)

    def shared_options(self, shards: Path, inception: Path | None) -> list[str]:
        """The options that `command` has in all rows of a table."""
        if self.cad_models is not None:
            _check_truth(shards, "CAD models are compared by pictures of true rooms")
        count = self.count or sum(1 for _ in iterate_rooms(shards, "train"))
        # Some methods decode meshes, others boxes only; --boxes compares the boxes of all methods.
        words = ["-n", str(count), "--seed", str(self.sampling_seed), "--boxes"]
        return words if inception is None else [*words, "--inception", str(inception)]


class ViewComparison(_Comparison):
    """Comparison of reconstructions from single views (the paper's Table 2), by `eval-svr`."""

    command: ClassVar = "eval-svr"
    option: ClassVar = "--fit"

    task: Literal["single_views"] = "single_views"
    count: int | None = Field(None, ge=1)
    """Number of test rooms whose views are reconstructed; None: all."""
    views: int = Field(1, ge=1)
    """Number of views reconstructed per test room; all if a room has fewer."""
    fits: tuple[Literal["objects", "paper"], ...] = Field(("objects",), min_length=1, strict=False)
    """Values of `eval-svr --fit` for runs that keep the latents of training rooms, one row each.
    Other methods reconstruct in their own way."""

    def variants(self, config: RunConfig) -> tuple[str | None, ...]:
        """Values of `option` for a run that keeps the latents of training rooms."""
        return self.fits

    def shared_options(self, shards: Path, inception: Path | None) -> list[str]:
        """The options that `command` has in all rows of a table."""
        _check_truth(shards, "Single views are compared with true rooms")
        words = ["--split", "test", "--views", str(self.views), "--seed", str(self.sampling_seed)]
        if self.count is not None:
            words += ["--limit", str(self.count)]
        return words + self.models(shards)


def _check_truth(shards: Path, compared: str) -> None:
    """Raise InputError if the test rooms have no 3D ground truth."""
    if not known_in_3d(shards, "test"):
        raise InputError(
            f"{compared}, and the 'test' rooms of {shards} are missing or not known in 3D; give "
            "shards of prep-front or prep-scannet."
        )


Comparison = RoomComparison | ViewComparison
TASKS: dict[str, type[Comparison]] = {"new_rooms": RoomComparison, "single_views": ViewComparison}
"""Class of the comparison, by the value of the key `task`."""


# -- Runs and rows ---------------------------------------------------------------------------------

PAPER, LIFTED = "the paper's method and variations of it", "the lifted method"
LIFTED_TARGETS = "the paper's network on lifted targets"
GIVEN = "scenes as given, which were made elsewhere"
LATENTS, FIT = "latents", "fit"
ROWS = {
    (LATENTS, False): ("Paper's method", "", PAPER),
    (LATENTS, True): ("Paper's network on lifted targets", "on lifted targets", LIFTED_TARGETS),
    (SAMPLER, True): ("Lifted method: sampler", "sampler of the lifted method", LIFTED),
    (FIT, False): ("Paper: fit of a latent", "fit of a latent", PAPER),
    (FIT, True): (
        "Fit of a latent, paper's network on lifted targets", "fit of a latent, on lifted targets",
        LIFTED_TARGETS,
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


class Variant(NamedTuple):
    """One way in which a run makes rooms or reconstructions; each has a command and a table row."""

    name: str | None
    """Value of `--distribution` or `--fit`; None leaves the option out."""
    title: str
    """Title of the row; empty if neither the comparison nor a config gives one."""
    made_by: str
    """Name of the method in captions."""
    result: Path
    """File of the variant's scores."""
    cad: bool = False
    """True if all objects are replaced by CAD models."""


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


def _of_rooms(rooms: Rooms, method: Method) -> list[str]:
    """Settings that a method takes from its rooms: their changes to the config that both share, or
    a few values for a config of its own."""
    if method.config is None:
        return list(rooms.set)
    shared, own = read_settings(rooms.config, rooms.set)[1], read_settings(method.config)[1]
    keys = ["label_set", "data.shards", "model.max_objects"]
    # Values are quoted as JSON, which is valid YAML, so that a folder called 2024 stays a string.
    return [
        f"{key}={json.dumps(value)}"
        for key in keys
        if (value := _value(shared, key)) is not None
        and (key != "model.max_objects" or _value(own, key) is not None)
    ]


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
    sampler, if it has one, comes first. Runs of other methods have a single variant. With
    `cad_models`, each variant of new rooms is followed by the same rooms with CAD models.
    """
    title, config = comparison.methods[run.method].title, run.run_config
    names = comparison.variants(config) if config.remembers_rooms else (None,)
    found = list[Variant]()
    for name in names:
        way = name
        if isinstance(comparison, ViewComparison):
            way = OBJECTS if name in (None, OBJECTS) else FIT
        plain, detail, made_by = made_by_run(config, way)
        row = plain if title is None else ", ".join(filter(None, (title, detail)))
        file = run.folder / ("scores.json" if not found else f"scores_{name}.json")
        found.append(Variant(name, row, made_by, file))
        # `eval-svr` scores reconstructions with CAD models and without in one result.
        if comparison.cad_models is not None and isinstance(comparison, RoomComparison):
            cad = file.with_stem(f"{file.stem}_cad")
            found.append(Variant(name, f"{row}, with CAD models", made_by, cad, cad=True))
    return found


def made_by_run(config: RunConfig, way: str | None = None) -> tuple[str, str, str]:
    """The entry of `ROWS` for a run and a way to make rooms: `OBJECTS`, `FIT`, or a distribution of
    new rooms (None: the run's default). Other methods are baselines, without a title."""
    if not isinstance(config, PaperConfig | LiftedConfig):
        return "", "", "baselines"
    way = way or config.distribution
    way = way if way in (SAMPLER, FIT, OBJECTS) else LATENTS
    return ROWS[way, isinstance(config, LiftedConfig)]
