"""The viewer's logic without its page: rooms of a prior, or of a folder."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

from sceneprior.apps.api import Prior
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene
from sceneprior.evaluation.metrics.contents import common_label_set
from sceneprior.lifted.trained import SAMPLER, TrainedLifted
from sceneprior.paper.sampling import DISTRIBUTIONS
from sceneprior.paper.trained import TrainedPrior

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
    """Rooms of a folder of scenes, of any method."""

    def __init__(self, scenes: Sequence[Scene]):
        self.scenes = tuple(scenes)

    @property
    def label_set(self) -> str:
        """The label set of all scenes; several are an InputError."""
        return common_label_set(self.scenes)

    def room(self, row: int) -> Shown:
        """The scene at an index."""
        scene = self.scenes[row]
        return Shown(scene, f"{scene.name}, {row + 1} of {len(self.scenes)}")


class Explorer:
    """Rooms of a trained prior: sampled, or completed."""

    def __init__(self, prior: Prior):
        self.prior = prior
        self.label_set = prior.label_set

    @property
    def has_latents(self) -> bool:
        """True if rooms are decoded from latents, as completion needs."""
        return isinstance(self.prior.trained, TrainedPrior)

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
        """True if a sampler draws rooms, as requests need."""
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
        """Keep the kept objects, and complete the room around them, with wishes if there are any.

        The shown room's floor, doors, windows and ceiling stay as well.
        """
        room = self.prior.complete(shown.given(), 1, seed, want=want or None)[0]
        kept = frozenset(range(len(shown.kept)))
        return Shown(room, f"completed around {len(kept)} kept objects, seed {seed}", kept)
