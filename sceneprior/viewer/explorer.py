"""What a page shows and can be asked for, without the page: rooms of a prior, or of a folder."""

import threading
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.api import Prior
from sceneprior.errors import InputError
from sceneprior.evaluation.layout_distance import nearest_room
from sceneprior.evaluation.metrics.contents import common_label_set
from sceneprior.generation.decode import decode_latents, to_rooms
from sceneprior.generation.interpolate import path_latents
from sceneprior.generation.sample import DISTRIBUTIONS, SAMPLER
from sceneprior.models.occupancy import OccupancyDecoder
from sceneprior.scene import Scene
from sceneprior.training.method import TrainedPrior
from sceneprior.viewer.latent_map import LatentMap, make_map

PATH_STEPS = 49
"""Rooms of a path, both ends included: seldom 4 degrees of the sphere apart."""
SOME = 64
"""Training rooms, at most, that say how large rooms are: all of them would take a second."""
HERE = "here"
"""Names the room that is shown as an end of a path."""


@dataclass(frozen=True)
class Shown:
    """A room on show."""

    scene: Scene
    origin: str
    """Where it comes from, in words."""
    kept: frozenset[int] = frozenset()
    """Objects that the next completion keeps, by their number in the scene."""

    def toggled(self, item: int) -> "Shown":
        """The same with an object kept, or no longer kept."""
        return replace(self, kept=self.kept ^ {item})

    def given(self) -> Scene:
        """The scene of the kept objects alone."""
        objects = tuple(self.scene.objects[item] for item in sorted(self.kept))
        return replace(self.scene, objects=objects, extra={}, latent=None)


class Folder:
    """Rooms of a folder of scenes, of any method."""

    def __init__(self, scenes: Sequence[Scene]):
        self.scenes = tuple(scenes)

    @property
    def label_set(self) -> str:
        """Of all scenes; an `InputError` where they have several."""
        return common_label_set(self.scenes)

    def some_layouts(self) -> tuple[Scene, ...]:
        """All of them."""
        return self.scenes

    def room(self, row: int) -> Shown:
        """One of them, counted from 0."""
        scene = self.scenes[row]
        return Shown(scene, f"{scene.name}, {row + 1} of {len(self.scenes)}")


class Explorer:
    """Rooms of a trained prior: sampled, from a place of the map, along a path, or completed."""

    def __init__(self, prior: Prior):
        self.prior = prior
        self.label_set = prior.label_set
        self.map: LatentMap | None = None
        self.without_map = ""
        """Why there is no map, where there is none."""
        try:
            self.map = make_map(prior.with_latents.prior.latent_space, self._training_z)
        except InputError as error:
            self.without_map = str(error)
        self.path: Float[Tensor, "steps dimension"] | None = None

    @property
    def has_latents(self) -> bool:
        """Whether latents make rooms, so that there are paths, and rooms can be completed."""
        return isinstance(self.prior.trained, TrainedPrior)

    @cached_property
    def _training_z(self) -> Float[Tensor, "rooms dimension"]:
        trained = self.prior.with_latents
        if not trained.remembers_rooms:
            raise InputError(
                "This prior keeps no latents of training rooms, so there is no map and no nearest "
                "room; sample rooms instead."
            )
        return trained.prior.latent_space(trained.logits)

    @property
    def distributions(self) -> tuple[str, ...]:
        """Where new rooms may come from, the prior's own way first; none for other methods."""
        trained = self.prior.trained
        if not isinstance(trained, TrainedPrior):
            return ()
        known = DISTRIBUTIONS if len(trained.logits) > 1 else ("paper",)
        known = (SAMPLER, *known) if trained.sampler is not None else known
        own = trained.distribution if trained.distribution in known else known[0]
        return (own, *(name for name in known if name != own))

    def sample(self, seed: int, distribution: str | None = None) -> Shown:
        """A new room, by the first of `distributions` unless told otherwise: the one that
        `sceneprior synthesize -n 1 --seed SEED` writes."""
        distribution = distribution or next(iter(self.distributions), None)
        origin = distribution or self.prior.trained.config.method
        scene = self.prior.sample(1, seed, distribution)[0]
        return Shown(scene, f"seed {seed}, from: {origin}")

    def training_room(self, row: int) -> Shown:
        """A training room as the prior remembers it."""
        room_id = self.prior.trained.room_ids[row]
        return self._decoded(self._training_z[row], room_id, f"training room {room_id}, decoded")

    def at(self, shown: Shown, point: tuple[float, float], click: bool = False) -> Shown:
        """The room at a point of the map, which keeps what the map does not show of the room that
        is shown. A click on a training room's dot is that room."""
        assert self.map is not None, "there is a map to point at"
        if click and (row := self.map.room_at(point)) is not None:
            return self.training_room(row)
        latent = shown.scene.latent
        start = self._training_z[0] if latent is None else self.prior.latent(latent)
        z = self.map.moved(start, point)
        x, y = self.map.place(z.unsqueeze(0))[0].tolist()
        return self._decoded(z, "from_the_map", f"map {x:+.3f}, {y:+.3f}")

    def draw_path(self, shown: Shown, start: str, end: str) -> Float[Tensor, "steps dimension"]:
        """Latents from one end to the other, for `step`.

        Args:
            start, end: As `sceneprior interpolate` reads them, or `HERE`.

        Raises:
            InputError: an end is unknown, or `HERE` where no latent made the room on show.
        """
        ends = [
            self.prior.latent(shown.scene if text.strip() == HERE else text.strip())
            for text in (start, end)
        ]
        self.path = path_latents(self.prior.with_latents, ends[0], ends[1], PATH_STEPS)
        return self.path

    def step(self, number: int) -> Shown:
        """A room of the path, counted from 0."""
        assert self.path is not None, "a path is drawn first"
        name = f"step_{number:02d}"
        return self._decoded(self.path[number], name, f"path, step {number} of {PATH_STEPS - 1}")

    def complete(self, shown: Shown, seed: int) -> Shown:
        """Keep the kept objects and furnish the rest anew."""
        room = self.prior.complete(shown.given(), 1, seed)[0]
        kept = frozenset(range(len(shown.kept)))
        return Shown(room, f"completed round {len(kept)} kept objects, seed {seed}", kept)

    def nearest(self, scene: Scene) -> tuple[Shown, float]:
        """The training room, as the prior remembers it, whose layout is nearest; metres between
        the two (`layout_distance`)."""
        row, distance_m = nearest_room(scene, self._layouts)
        return self.training_room(row), distance_m

    @cached_property
    def _layouts(self) -> list[Scene]:
        return self._boxes_of(range(len(self._training_z)))

    def _boxes_of(self, rows: Sequence[int]) -> list[Scene]:
        """Training rooms as the prior remembers them, without shapes."""
        trained = self.prior.with_latents
        with torch.no_grad():
            decoded = trained.prior.decode(self._training_z[list(rows)], with_shape=False)
        names = [trained.room_ids[row] for row in rows]
        target = trained.config.model.completeness_target
        rooms = to_rooms(decoded, trained.prior, self.label_set, names, target)
        return [room.scene for room in rooms]

    def some_layouts(self) -> list[Scene]:
        """Rooms as boxes that say how large rooms are."""
        if self.map is not None:
            most = len(self._training_z)
            return self._boxes_of(range(0, most, -(-most // SOME)))
        return self.prior.sample(16, 0, next(iter(self.distributions), None))

    def find_meshes(self, stop: threading.Event) -> None:
        """Find the meshes of all shapes that the prior knows, so that no room has to wait."""
        trained = self.prior.trained
        if isinstance(trained, TrainedPrior) and isinstance(trained.prior.shape, OccupancyDecoder):
            for prototype in trained.prior.shape.known:
                if stop.is_set():
                    return
                trained.prior.shape.surface(prototype)

    def _decoded(self, z: Float[Tensor, " dimension"], name: str, origin: str) -> Shown:
        rooms = decode_latents(self.prior.with_latents, z.unsqueeze(0), [name])
        return Shown(rooms[0], origin)


def floor_side_m(scenes: Sequence[Scene]) -> float:
    """Side of a square of floor round the origin on which most rooms have their furniture: the 80%
    quantile, in whole metres, at least 4."""
    reach = [
        np.abs(scene.centers_m[:, [0, 2]]).max() + scene.sizes_m[:, [0, 2]].max() / 2
        for scene in scenes
        if scene.objects
    ]
    return max(4.0, float(np.ceil(2 * np.quantile(reach, 0.8)))) if reach else 4.0
