"""Settings of `sceneprior compare`, and the runs that result from them."""

import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import Field, field_validator, model_validator

from sceneprior.apps.config import load_config
from sceneprior.apps.experiments.makers import GIVEN, maker_of_answers, maker_of_rooms
from sceneprior.apps.reconstruction.reconstruct import OBJECTS
from sceneprior.core.errors import ConfigError, InputError
from sceneprior.core.seeds import LARGEST_SEED
from sceneprior.core.settings import Section, check_settings, read_settings
from sceneprior.lifted.trained import SAMPLER
from sceneprior.training.method import RunConfig

_T = TypeVar("_T")
EVERY = "every"
"""Key of `Method.set` for settings that apply to every kind of room."""


class Rooms(Section):
    """A kind of room to compare on."""

    config: str
    """Run config of the paper's or the lifted method; all methods use the rooms of this config."""
    set: tuple[str, ...] = Field((), strict=False)
    """Changes to the config as `section.key=value`, for example other shards."""
    title: str
    """Heading of the table of these rooms."""


class Method(Section):
    """One method of a comparison: a method to train, or existing scenes."""

    title: str | None = None
    """Title of the method's rows. None takes the title from the config (`makers.py`), which works
    only for the paper's and the lifted method. Variations of these need a title; the table appends
    the kind of supervision and the distribution."""
    config: str | None = None
    """The method's own run config; None takes the config of the rooms. Label set, shards, seed and
    `model.max_objects` (if the config has this key) come from the rooms in either case."""
    set: dict[str, list[str]] = Field(default_factory=dict)
    """Changes to the config as `section.key=value`, by kind of room; changes under `every` are
    applied first."""
    scenes: dict[str, str] = Field(default_factory=dict)
    """Folders of scenes, by kind of room, instead of `config` and `set`: nothing is trained, and
    the scenes are evaluated as they are."""

    @model_validator(mode="after")
    def _trained_or_given(self) -> "Method":
        if self.scenes and (self.config is not None or self.set):
            raise ValueError(
                "scenes are evaluated as they are, so `config` and `set` have no effect on them; "
                "leave out `scenes`, or `config` and `set`"
            )
        if self.scenes and self.title is None:
            raise ValueError("scenes need a title, since no config names their method")
        return self


class Comparison(Section):
    """A comparison: every method is run on every kind of room with every seed."""

    seeds: tuple[int, ...] = Field(min_length=1, strict=False)
    """Seeds of training; each gives one run."""
    sampling_seed: int = Field(0, ge=0, le=LARGEST_SEED)
    """Seed of the generated rooms, or of the views to reconstruct, the same for every run."""
    rooms: dict[str, Rooms] = Field(min_length=1)
    methods: dict[str, Method] = Field(min_length=1)

    @field_validator("seeds")
    @classmethod
    def _each_once(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds) or min(seeds) < 0:
            raise ValueError("seeds must be distinct integers of at least 0")
        return seeds

    @model_validator(mode="after")
    def _names_are_clear(self) -> "Comparison":
        titles = [rooms.title for rooms in self.rooms.values()]
        if twice := [title for title in titles if titles.count(title) > 1]:
            raise ValueError(f"the title '{twice[0]}' is given twice; a title names a table")
        known = ", ".join(self.rooms)
        for key, method in self.methods.items():
            if unlisted := sorted(set(method.set) - {EVERY, *self.rooms}):
                raise ValueError(
                    f"methods.{key}.set has '{unlisted[0]}'; expected {EVERY} or one of {known}"
                )
            if unlisted := sorted(set(method.scenes) - set(self.rooms)):
                raise ValueError(
                    f"methods.{key}.scenes has '{unlisted[0]}'; expected one of {known}"
                )
        return self


class RoomComparison(Comparison):
    """Comparison of new rooms (the paper's Tables 1, 3 and 4)."""

    task: Literal["new_rooms"] = "new_rooms"
    count: int | None = Field(None, ge=2)
    """Number of rooms that each run generates for its evaluation. None takes the number of training
    rooms, at which Frechet distances can be compared with those of the reference rows."""
    distributions: tuple[Literal["paper", "kernel"], ...] = Field(
        ("paper", "kernel"), min_length=1, strict=False
    )
    """Distributions of latents for evaluating priors that keep the latents of training rooms, one
    row each. Other methods are evaluated with their own distribution."""


class ViewComparison(Comparison):
    """Comparison of reconstructions from single views (the paper's Table 2)."""

    task: Literal["single_views"] = "single_views"
    count: int | None = Field(None, ge=1)
    """Number of test rooms whose views are reconstructed; None: all."""
    views: int = Field(1, ge=1)
    """Number of views reconstructed per test room; all if a room has fewer."""
    fits: tuple[Literal["objects", "paper"], ...] = Field(("objects",), min_length=1, strict=False)
    """Values of `eval-svr --fit` for runs that keep the latents of training rooms, one row each.
    Other methods reconstruct in their own way."""
    cad_models: str | None = None
    """Value of `eval-svr --models`: a folder of CAD models, or `shards` for the CAD models of the
    training rooms. Null leaves out the rows with CAD models."""

    @model_validator(mode="after")
    def _answers_the_same_views(self) -> "ViewComparison":
        for key, method in self.methods.items():
            if method.scenes:
                raise ValueError(
                    f"methods.{key}.scenes: the comparison chooses the views to reconstruct; "
                    "score existing scenes with `sceneprior eval-svr --scenes`"
                )
        return self


TASKS: dict[str, type[Comparison]] = {"new_rooms": RoomComparison, "single_views": ViewComparison}
"""Class of the comparison, by the value of the key `task`."""


@dataclass(frozen=True)
class Run:
    """One training with one seed, or a folder of scenes, which needs no training."""

    rooms: str
    method: str
    seed: int | None
    """Seed of training; None for scenes."""
    config: str
    settings: tuple[str, ...]
    """Changes to the config, for `fit --set`."""
    folder: Path
    scenes: Path | None = None
    """Folder of existing scenes, made by any method; None for a method to train."""

    @property
    def run_config(self) -> RunConfig:
        """The settings of the run's training; for scenes, the config of their kind of rooms."""
        return load_config(self.config, self.settings)

    @property
    def title(self) -> str:
        seed = () if self.seed is None else (f"seed {self.seed}",)
        return ", ".join((self.rooms, self.method, *seed))


@dataclass(frozen=True)
class Variant:
    """One way in which a run makes rooms or reconstructions; each has a command and a table row."""

    name: str | None
    """Value of `--distribution` or `--fit`; None leaves the option out."""
    title: str
    """Title of the row; empty if neither the comparison nor a config gives one."""
    made_by: str
    """Name, in captions, of the method that made the rooms or reconstructions (`Maker.said`)."""
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


def part_of(
    comparison: Comparison, methods: str | None, rooms: str | None, seeds: str | None
) -> Comparison:
    """The part of a comparison with the given methods, kinds of rooms and seeds, each as `a,b`;
    None means all."""
    by_seed = {str(seed): seed for seed in comparison.seeds}
    return comparison.model_copy(
        update={
            "methods": _chosen("method", methods, comparison.methods),
            "rooms": _chosen("kind of rooms", rooms, comparison.rooms),
            "seeds": tuple(_chosen("seed", seeds, by_seed).values()),
        }
    )


def _chosen(what: str, given: str | None, known: dict[str, _T]) -> dict[str, _T]:
    if given is None:
        return known
    names = [name.strip() for name in given.split(",") if name.strip()]
    for name in names:
        if name not in known:
            raise InputError(f"No {what} '{name}' in this comparison; it has {', '.join(known)}.")
    if not names:
        raise InputError(f"No {what} was named; the comparison has {', '.join(known)}.")
    return {name: entry for name, entry in known.items() if name in names}


def runs_of(comparison: Comparison, out: Path) -> list[Run]:
    """All runs: scenes first, then seed by seed, so that a comparison stopped early is complete for
    fewer seeds.
    """
    runs = []
    for seed in (None, *comparison.seeds):
        for (key, rooms), (name, method) in product(
            comparison.rooms.items(), comparison.methods.items()
        ):
            folder = out / key / name
            if seed is None and key in method.scenes:
                scenes = Path(method.scenes[key])
                runs.append(Run(key, name, None, rooms.config, rooms.set, folder, scenes))
            elif seed is not None and not method.scenes:
                changes = (*method.set.get(EVERY, ()), *method.set.get(key, ()))
                settings = (*_of_rooms(rooms, method), *changes, f"seed={seed}")
                config = method.config or rooms.config
                runs.append(Run(key, name, seed, config, settings, folder / f"seed{seed}"))
    return runs


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


def variants_of(comparison: Comparison, run: Run) -> list[Variant]:
    """The variants of a run, in the order of their rows.

    A run that keeps the latents of training rooms has one variant per distribution or fit; its
    sampler, if it has one, comes first. Scenes and runs of other methods have a single variant.
    """
    config = run.run_config
    names: tuple[str | None, ...] = (None,)
    if run.scenes is None and config.remembers_rooms:
        if isinstance(comparison, ViewComparison):
            names = comparison.fits
        elif isinstance(comparison, RoomComparison):
            own = (None,) if getattr(config, "distribution", None) == SAMPLER else ()
            names = (*own, *comparison.distributions)
    found = []
    for name in names:
        if run.scenes is not None:
            maker = GIVEN
        elif isinstance(comparison, ViewComparison):
            maker = maker_of_answers(config, name or OBJECTS)
        else:
            maker = maker_of_rooms(config, name)
        title = maker.named(comparison.methods[run.method].title)
        file = "scores.json" if name == names[0] else f"scores_{name}.json"
        found.append(Variant(name, title, maker.said, run.folder / file))
    return found


def shards_of(comparison: Comparison, rooms: str) -> Path:
    """The folder of shards that holds a kind of rooms."""
    kind = comparison.rooms[rooms]
    return Path(load_config(kind.config, kind.set).data.shards)
