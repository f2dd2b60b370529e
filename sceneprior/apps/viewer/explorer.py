"""The viewer's rooms, without a page: those of a trained prior, or of a folder of scenes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from sceneprior.apps.api import Prior
from sceneprior.apps.viewer.latent_map import LatentMap, make_map
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metrics.contents import common_label_set
from sceneprior.evaluation.metrics.novelty import KnownRooms
from sceneprior.lifted.config import SAMPLER, TrainedLifted
from sceneprior.paper.interpolate import RoomPath, even_places
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import (
    DISTRIBUTIONS,
    decode_latents,
    named_latent,
    to_rooms,
    with_training_latents,
)

SOME = 64
"""Most training rooms from which the size of rooms is estimated."""
PATH_STEPS = 49
"""Number of rooms of a path with both ends; neighbours are rarely more than 4 degrees apart."""
HERE = "here"
"""Text that names the shown room as an end of a path."""
NOTHING_ASKED: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class Shown:
    """The shown room."""

    scene: Scene
    origin: str
    """Origin of the room, in words."""
    kept: frozenset[int] = frozenset()
    """Indices of the objects that the next completion keeps."""

    def toggled(self, item: int) -> "Shown":
        """The same room with `kept` toggled for an object."""
        return replace(self, kept=self.kept ^ {item})

    def given(self) -> Scene:
        """The scene of the kept objects alone."""
        objects = tuple(self.scene.objects[item] for item in sorted(self.kept))
        return replace(self.scene, objects=objects, extra={}, latent=None)


class Folder:
    """A folder of scenes, made by any method."""

    def __init__(self, scenes: Sequence[Scene]):
        self.scenes = tuple(scenes)

    @property
    def label_set(self) -> str:
        """The label set of all scenes; several are an InputError."""
        return common_label_set(self.scenes)

    def layouts(self) -> Sequence[Scene]:
        """Rooms from which the size of rooms is estimated: all of the folder."""
        return self.scenes

    def room(self, row: int) -> Shown:
        """The scene at an index."""
        scene = self.scenes[row]
        return Shown(scene, f"{scene.name}, {row + 1} of {len(self.scenes)}")


class Explorer:
    """Rooms of a trained prior: sampled, at a map point, along a path, or completed."""

    def __init__(self, prior: Prior):
        self.prior = prior
        self.label_set = prior.label_set
        self.map: LatentMap | None = None
        self.without_map = ""
        """The reason if there is no map, else empty."""
        try:
            self.map = make_map(prior.with_latents.prior.latent_space, self._training_z)
        except InputError as error:
            self.without_map = str(error)
        self.path: RoomPath | None = None

    @property
    def has_latents(self) -> bool:
        """True if rooms are decoded from latents, as paths need."""
        return isinstance(self.prior.trained, TrainedPrior)

    @cached_property
    def _training_z(self) -> Float[Tensor, "rooms dimension"]:
        trained = with_training_latents(self.prior.with_latents, "The map")
        return trained.prior.latent_space(trained.logits)

    @property
    def distributions(self) -> tuple[str, ...]:
        """Distributions of latents for new rooms, the default first; empty without latents."""
        trained = self.prior.trained
        if not isinstance(trained, TrainedPrior):
            return ()
        known = DISTRIBUTIONS if len(trained.logits) > 1 else ("paper",)
        if isinstance(trained, TrainedLifted) and trained.sampler is not None:
            known = (SAMPLER, *known)
        own = trained.distribution if trained.distribution in known else known[0]
        return (own, *(name for name in known if name != own))

    @property
    def takes_requests(self) -> bool:
        """True if a sampler draws rooms, as requests and completion need."""
        return SAMPLER in self.distributions

    def sample(
        self,
        seed: int,
        distribution: str | None = None,
        asked: Mapping[str, Any] = NOTHING_ASKED,
    ) -> Shown:
        """Sample a new room, by default from the first of `distributions`.

        It equals the room of `sceneprior synthesize -n 1 --seed SEED` with the same request.

        Args:
            asked: Arguments of `Prior.sample` for a requested room.
        """
        distribution = distribution or next(iter(self.distributions), None)
        if asked and distribution != SAMPLER:
            raise InputError(
                f"Rooms from {distribution} answer no requests; choose {SAMPLER} under From, or "
                "clear the request."
            )
        origin = distribution or self.prior.trained.config.method
        scene = self.prior.sample(1, seed, distribution, **asked)[0]
        return Shown(scene, f"seed {seed}, from: {origin}{', as requested' if asked else ''}")

    def complete(self, shown: Shown, seed: int, want: str = "") -> Shown:
        """Complete the room around the kept objects, with wishes if there are any.

        The shown room's floor, doors, windows and ceiling also stay.
        """
        room = self.prior.complete(shown.given(), 1, seed, want=want or None)[0]
        kept = frozenset(range(len(shown.kept)))
        return Shown(room, f"completed around {len(kept)} kept objects, seed {seed}", kept)

    def training_room(self, row: int) -> Shown:
        """A training room as the prior decodes it."""
        room_id = self.prior.trained.room_ids[row]
        return self._decoded(self._training_z[row], room_id, f"training room {room_id}, decoded")

    def at(self, shown: Shown, point: tuple[float, float], click: bool = False) -> Shown:
        """The room at a map point, which keeps the shown room's other latent coordinates.

        A click on a training room's dot gives that room.
        """
        assert self.map is not None, "there is a map to point at"
        if click and (row := self.map.room_at(point)) is not None:
            return self.training_room(row)
        latent = shown.scene.latent
        start = self._training_z[0] if latent is None else self.prior.latent(latent)
        z = self.map.moved(start, point)
        x, y = self.map.place(z.unsqueeze(0))[0].tolist()
        return self._decoded(z, "from_the_map", f"map {x:+.3f}, {y:+.3f}")

    def _decoded(self, z: Float[Tensor, " dimension"], name: str, origin: str) -> Shown:
        rooms = decode_latents(self.prior.with_latents, z.unsqueeze(0), [name])
        return Shown(rooms[0], origin)

    def draw_path(self, shown: Shown, start: str, end: str) -> Float[Tensor, "steps dimension"]:
        """Set the path of `step`, and return its latents from start to end.

        An end is a training room's id, `paper:7` (New room's seed 7 from `paper`) or `HERE`. Files
        are not accepted, since the text comes from a browser, which may run on another machine.
        """
        ends = [
            self.prior.latent(shown.scene)
            if text.strip() == HERE
            else named_latent(self.prior.with_latents, text.strip(), f"{HERE}, the shown room")
            for text in (start, end)
        ]
        path = RoomPath(self.prior.with_latents, ends[0], ends[1])
        z = path.latents(even_places(PATH_STEPS))
        self.path = path
        return z

    def step(self, number: int) -> Shown:
        """The room at a step of the path, counted from 0."""
        assert self.path is not None, "a path is drawn first"
        place = even_places(PATH_STEPS)[[number]]
        (room,) = self.path.rooms(place, [f"step_{number:02d}"])
        return Shown(room.scene, f"path, step {number} of {PATH_STEPS - 1}")

    def nearest(self, scene: Scene) -> tuple[Shown, float]:
        """The decoded training room with the nearest layout, and its distance in metres."""
        row, distance_m = KnownRooms(self._training_layouts).nearest(scene)
        return self.training_room(row), distance_m

    def layouts(self) -> Sequence[Scene]:
        """Rooms from which the size of rooms is estimated: some training rooms, or new ones."""
        if self.map is not None:
            most = len(self._training_z)
            return self._boxes_of(range(0, most, -(-most // SOME)))
        return self.prior.sample(16, 0, next(iter(self.distributions), None))

    @cached_property
    def _training_layouts(self) -> list[Scene]:
        return self._boxes_of(range(len(self._training_z)))

    def _boxes_of(self, rows: Sequence[int]) -> list[Scene]:
        """Training rooms as the prior decodes them, without shapes; a second for 500 rooms."""
        trained = self.prior.with_latents
        with torch.no_grad():
            decoded = trained.prior.decode(self._training_z[list(rows)], with_shape=False)
        names = [trained.room_ids[row] for row in rows]
        target = trained.config.model.completeness_target
        rooms = to_rooms(decoded, trained.prior, self.label_set, names, target)
        return [room.scene for room in rooms]


def floor_side_m(scenes: Sequence[Scene]) -> float:
    """Side of a square floor around the origin that holds the furniture of most rooms.

    It is the 80% quantile over rooms, rounded up to whole metres, at least 4.
    """
    reach = [
        np.abs(scene.centers_m[:, [0, 2]]).max() + scene.sizes_m[:, [0, 2]].max() / 2
        for scene in scenes
        if scene.objects
    ]
    return max(4.0, float(np.ceil(2 * np.quantile(reach, 0.8)))) if reach else 4.0
