"""Settings of `sceneprior compare`: kinds of rooms, methods, seeds and the task."""

from typing import Literal

from pydantic import Field, field_validator, model_validator

from sceneprior.core.repeatable import LARGEST_SEED
from sceneprior.core.settings import Section

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
    """One method of a comparison."""

    title: str | None = None
    """Title of the method's rows. None takes the title from the config (`runs.py`), which works
    only for the paper's and the lifted method. Variations of these need a title; the table appends
    the kind of supervision and the distribution."""
    config: str | None = None
    """The method's own run config; None takes the config of the rooms. Label set, shards, seed and
    `model.max_objects` (if the config has this key) come from the rooms in either case."""
    set: dict[str, list[str]] = Field(default_factory=dict)
    """Changes to the config as `section.key=value`, by kind of room; changes under `every` are
    applied first."""


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


TASKS: dict[str, type[Comparison]] = {"new_rooms": RoomComparison, "single_views": ViewComparison}
"""Class of the comparison, by the value of the key `task`."""
