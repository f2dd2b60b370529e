"""The viewer's rooms of a trained prior, without a page: requested, completed, or decoded."""

import contextlib
from collections import Counter
from dataclasses import asdict, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float
from torch import Tensor

from sceneprior.apps.api import Prior
from sceneprior.apps.viewer.map import LatentMap, Point, make_map
from sceneprior.apps.viewer.requested import clauses_of, line_of, read_line, sentence_of
from sceneprior.apps.viewer.shown import NOTHING_ASKED, Shown
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Opening, Scene
from sceneprior.lifted.requests.checks import answers
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.lifted.requests.wishes import Conditions, Wishes
from sceneprior.lifted.trained import SAMPLER, TrainedLifted
from sceneprior.paper.interpolate import RoomPath, even_places
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.sampling import (
    DISTRIBUTIONS,
    decode_latents,
    named_latent,
    with_training_latents,
)

PATH_STEPS = 49
"""Number of rooms of a path with both ends; neighbours are rarely more than 4 degrees apart."""
HERE = "here"
"""Text that names the shown room as an end of a path."""
_EXAMPLES = (
    "4 x 3 m, a door, a double bed and two nightstands beside it",
    "a desk under the window, a chair and no sofa",
    "two single beds far from the door",
    "5 x 4 m, a door, a sofa facing the tv stand",
    "a coffee table in front of the sofa, two armchairs",
    "a table and four chairs near it, a window",
)
"""Requests to try; the first three that a prior understands are offered."""


class Explorer:
    """Rooms of a trained prior: sampled, at a map point, along a path, or completed."""

    def __init__(self, prior: Prior):
        self.prior = prior
        self.label_set = prior.label_set
        self.map: LatentMap | None = None
        with contextlib.suppress(InputError):  # latents of training rooms are optional
            self.map = make_map(prior.with_latents.prior.latent_space, self._training_z)
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

    @cached_property
    def examples(self) -> tuple[str, ...]:
        """Three requests that this prior understands; none without a sampler."""
        found = []
        for line in _EXAMPLES if self.takes_requests else ():
            with contextlib.suppress(InputError):
                self.understood(RoomRequest.of(want=line))
                found.append(line)
        return tuple(found[:3])

    @cached_property
    def known(self) -> list[str]:
        """Classes that the sampler draws."""
        trained = self.prior.trained
        assert isinstance(trained, TrainedLifted) and trained.sampler is not None, "a sampler"
        return [self.prior.classes[row] for row in trained.sampler.drawn_classes]

    def understood(self, request: RoomRequest) -> Conditions:
        """A request as the prior understands it; InputError if it does not."""
        trained = self.prior.trained
        assert isinstance(trained, TrainedLifted) and trained.sampler is not None, "a sampler"
        sampler, names = trained.sampler, self.prior.classes
        meets = sampler.may_meet.nonzero().tolist()
        may_meet = {frozenset(names[index] for index in pair) for pair in meets}
        return request.conditions(
            self.known, self.label_set, sampler.max_objects, may_meet=may_meet
        )

    def ticks(self, shown: Shown) -> list[tuple[str, bool]]:
        """Each clause of the state's request, and whether the shown room meets it."""
        if not shown.line:
            return []
        given, found = RoomRequest(objects=shown.request.objects), list[tuple[str, bool]]()
        whole = self.understood(shown.request).wishes.bounds

        def is_understood(text: str) -> bool:
            with contextlib.suppress(InputError):
                return bool(self.understood(read_line(text, given)))
            return False

        for text in clauses_of(shown.line, is_understood):
            holds = False
            with contextlib.suppress(InputError):  # a clause may need the others
                asked = self.understood(read_line(text, given))
                # Of two clauses about a class, the numbers are added.
                counts = tuple(
                    replace(wish, most=None)
                    if whole.get(wish.label, (0, 0))[1] > (wish.most or 0)
                    else wish
                    for wish in asked.wishes.counts
                )
                asked = replace(asked, wishes=replace(asked.wishes, counts=counts))
                holds = self._holds(shown.scene, asked)
            found.append((text, holds))
        return found

    def _holds(self, scene: Scene, asked: Conditions) -> bool:
        fronts = np.zeros((len(scene.objects), 2))  # drawn objects have yaws of their own
        found = answers(scene, asked, fronts)
        return all(each["holds"] for each in found if not each.get("implied"))

    def sample(
        self,
        seed: int,
        distribution: str | None = None,
        request: RoomRequest = NOTHING_ASKED,
        line: str = "",
    ) -> Shown:
        """Sample a new room, by default from the first of `distributions`.

        It equals the room of `sceneprior synthesize -n 1 --seed SEED` with the same request.
        """
        distribution, asked = distribution or next(iter(self.distributions), None), request.parts()
        if asked and distribution != SAMPLER:
            raise InputError(
                f"Rooms from {distribution} answer no requests; choose {SAMPLER} under From, or "
                "clear the request."
            )
        origin = distribution or self.prior.trained.config.method
        scene = self.prior.sample(1, seed, distribution, **asked)[0]
        locked = frozenset(range(len(request.objects)))
        line = line or line_of(request)
        return Shown(scene, f"Room of seed {seed}, from {origin}", request, line, locked)

    def complete(self, shown: Shown, seed: int) -> Shown:
        """Complete the room around the locked objects, as its request wants it.

        The floor, doors, windows and ceiling also stay, unless the request has others by now.
        """
        given, more = shown.given(), dict[str, Any]()
        if shown.request.parts():
            asked, stays = self.understood(shown.request), True
            if asked.floor is not None:
                stays = np.array_equal(given.floor_m, asked.floor.outline_m)  # type: ignore[arg-type]
                given = replace(given, floor_m=asked.floor.outline_m)
            openings = replace(asked, floor=None, ceiling_m=None, wishes=Wishes())
            if not (stays and self._holds(shown.scene, openings)):
                given = replace(given, openings=())
                told = [each if isinstance(each, Opening) else str(each) for each in asked.openings]
                more["openings"] = told or None
            more["want"] = sentence_of(asked.wishes) or None
            more["ceiling_m"] = asked.ceiling_m
        return self._completed(shown, given, seed, more)

    def follow(self, shown: Shown, seed: int) -> Shown:
        """Place the unlocked objects anew around the locked ones: as many of each class as there
        are, with the relations of the request."""
        counts = Counter(item.label for item in shown.scene.objects)
        want: dict[str, Any] = {label: counts[label] for label in self.known}
        if shown.request.parts():
            relations = self.understood(shown.request).wishes.relations
            want["relations"] = [asdict(wish) for wish in relations]
        return self._completed(shown, shown.given(), seed, {"want": want})

    def _completed(self, shown: Shown, given: Scene, seed: int, more: dict[str, Any]) -> Shown:
        room = self.prior.complete(given, 1, seed, **more)[0]
        count = len(given.objects)
        pieces = f"{count} locked piece{'s' * (count > 1)}"
        origin = f"Completed around {pieces}, seed {seed}"
        return replace(
            shown, scene=room, origin=origin, locked=frozenset(range(count)), picked=None
        )

    def training_room(self, row: int) -> Shown:
        """A training room as the prior decodes it."""
        room_id = self.prior.trained.room_ids[row]
        return self._decoded(self._training_z[row], room_id, f"Training room {room_id}, decoded")

    def at(self, shown: Shown, point: Point, click: bool = False) -> Shown:
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
        return self._decoded(z, "from_the_map", f"Map at {x:+.3f}, {y:+.3f}")

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
        return Shown(room.scene, f"Path, step {number} of {PATH_STEPS - 1}")
