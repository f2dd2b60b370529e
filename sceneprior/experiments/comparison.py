"""What `sceneprior compare` compares: the settings in its YAML, and the runs that they ask for."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import Field, field_validator, model_validator

from sceneprior.config import load_config
from sceneprior.errors import ConfigError, InputError
from sceneprior.generation.sample import SAMPLER
from sceneprior.settings import Section, check_settings, read_settings

EVERY = "every"
"""In `Method.set`: settings for every kind of room."""


class Rooms(Section):
    """A kind of room to compare on."""

    config: str
    """The run config of our own method; it says which rooms all methods learn from."""
    title: str
    """Heading of its table."""


class Method(Section):
    """A row of the table."""

    title: str
    group: str
    """Methods of one group stand together, under this heading."""
    config: str | None = None
    """The method's own run config; None: that of the rooms. Label set, shards, seed and, where it
    has the key, `model.max_objects` are the rooms' in either case."""
    set: dict[str, list[str]] = Field(default_factory=dict)
    """Changes to the config as `section.key=value`, by kind of room; those for `every` first."""


class Comparison(Section):
    """Methods by kinds of rooms by seeds."""

    seeds: tuple[int, ...] = Field(min_length=1, strict=False)
    """A run each; the seed of training."""
    sampling_seed: int = Field(0, ge=0)
    """Of the generated rooms, or of the views that are answered, the same for every run."""
    rooms: dict[str, Rooms] = Field(min_length=1)
    methods: dict[str, Method] = Field(min_length=1)

    @field_validator("seeds")
    @classmethod
    def _each_once(cls, seeds: tuple[int, ...]) -> tuple[int, ...]:
        if len(set(seeds)) < len(seeds) or min(seeds) < 0:
            raise ValueError("seeds are numbers from 0 on, each once")
        return seeds

    @model_validator(mode="after")
    def _names_are_clear(self) -> "Comparison":
        for named in (self.rooms, self.methods):
            titles = [entry.title for entry in named.values()]
            if twice := [title for title in titles if titles.count(title) > 1]:
                raise ValueError(f"the title '{twice[0]}' is given twice; a title names a row")
        for key, method in self.methods.items():
            if unlisted := sorted(set(method.set) - {EVERY, *self.rooms}):
                raise ValueError(
                    f"methods.{key}.set has '{unlisted[0]}'; expected {EVERY} or one of "
                    f"{', '.join(self.rooms)}"
                )
        return self


class RoomComparison(Comparison):
    """Of new rooms (the paper's Tables 1, 3 and 4)."""

    task: Literal["new_rooms"] = "new_rooms"
    count: int | None = Field(None, ge=2)
    """Rooms that each run generates and is evaluated by. None: as many as there are training rooms,
    the numbers at which Frechet distances compare with those of the reference rows."""
    distributions: tuple[Literal["paper", "gaussian", "geodesic", "kernel"], ...] = Field(
        ("paper", "kernel"), min_length=1, strict=False
    )
    """Where the latents of priors that remember training rooms come from, a row each. Pictures show
    the first. Methods without such latents have their own."""


class ViewComparison(Comparison):
    """Of answers to single views (the paper's Table 2)."""

    task: Literal["single_views"] = "single_views"
    count: int | None = Field(None, ge=1)
    """Test rooms of which one view each is answered; None: all."""
    cad_models: str | None = None
    """What `eval-svr --models` takes: a folder of CAD models, or `shards` for those of the training
    rooms. Null: no rows with CAD models."""


TASKS: dict[str, type[Comparison]] = {"new_rooms": RoomComparison, "single_views": ViewComparison}
"""What a comparison compares, by the value of its key `task`."""
C = TypeVar("C", bound=Comparison)


@dataclass(frozen=True)
class Run:
    """One training with one seed, and where it goes."""

    rooms: str
    method: str
    seed: int
    config: str
    settings: tuple[str, ...]
    """Changes to the config, for `fit --set`."""
    folder: Path

    @property
    def title(self) -> str:
        return f"{self.rooms}, {self.method}, seed {self.seed}"


def load_comparison(name: str) -> Comparison:
    """Read a comparison and check the settings of each of its runs.

    Raises:
        ConfigError: not found, not YAML, an unknown key or a wrong value, in it or in a run.
    """
    path, data = read_settings(name)
    task = data.get("task", "new_rooms")
    if not isinstance(task, str) or task not in TASKS:
        raise ConfigError(f"{path}: no task is called '{task}'; choose from {', '.join(TASKS)}.")
    comparison = check_settings(TASKS[task], data, str(path))
    for run in runs_of(comparison, Path()):
        load_config(run.config, run.settings)
    return comparison


def part_of(comparison: C, methods: str | None, rooms: str | None, seeds: str | None) -> C:
    """Some methods, kinds of rooms and seeds of a comparison, each given as `a,b`; None is all.

    Raises:
        InputError: the comparison has no such entry.
    """
    kept_methods = _chosen("method", methods, tuple(comparison.methods))
    kept_rooms = _chosen("kind of rooms", rooms, tuple(comparison.rooms))
    kept_seeds = _chosen("seed", seeds, tuple(str(seed) for seed in comparison.seeds))
    return comparison.model_copy(
        update={
            "methods": {key: comparison.methods[key] for key in kept_methods},
            "rooms": {key: comparison.rooms[key] for key in kept_rooms},
            "seeds": tuple(int(seed) for seed in kept_seeds),
        }
    )


def _chosen(what: str, given: str | None, known: tuple[str, ...]) -> tuple[str, ...]:
    if given is None:
        return known
    names = tuple(name.strip() for name in given.split(",") if name.strip())
    for name in names:
        if name not in known:
            raise InputError(f"No {what} '{name}' in this comparison; it has {', '.join(known)}.")
    if not names:
        raise InputError(f"No {what} was named; the comparison has {', '.join(known)}.")
    return tuple(name for name in known if name in names)


def runs_of(comparison: Comparison, out: Path) -> list[Run]:
    """Every run, seed by seed, so that a comparison that is stopped early is a whole one of fewer
    seeds.

    Raises:
        ConfigError: the config of rooms or of a method is not found, or not YAML.
    """
    return [
        Run(
            rooms=key,
            method=name,
            seed=seed,
            config=method.config or rooms.config,
            settings=(
                *_taken_over(rooms, method),
                *method.set.get(EVERY, ()),
                *method.set.get(key, ()),
                f"seed={seed}",
            ),
            folder=out / key / name / f"seed{seed}",
        )
        for seed in comparison.seeds
        for key, rooms in comparison.rooms.items()
        for name, method in comparison.methods.items()
    ]


def _taken_over(rooms: Rooms, method: Method) -> list[str]:
    """What a method with a config of its own shares with the others on the same rooms."""
    if method.config is None:
        return []
    shared, own = read_settings(rooms.config)[1], read_settings(method.config)[1]
    keys = ["label_set", "data.shards"]
    if _value(own, "model.max_objects") is not None:
        keys.append("model.max_objects")
    values = {key: _value(shared, key) for key in keys}
    # As JSON, which YAML reads as it is: a folder may be called 2024.
    return [f"{key}={json.dumps(v)}" for key, v in values.items() if v is not None]


def _value(data: Any, key: str) -> Any:
    for part in key.split("."):
        data = data.get(part) if isinstance(data, dict) else None
    return data


def distributions_of(comparison: RoomComparison, run: Run) -> tuple[str | None, ...]:
    """Where rooms of a run come from, a row of the table each; None is the run's own way, which is
    all that methods without latents have, and comes first where that is a sampler."""
    config = load_config(run.config, run.settings)
    if not config.remembers_rooms:
        return (None,)
    own = (None,) if getattr(config, "distribution", None) == SAMPLER else ()
    return (*own, *comparison.distributions)
