"""Settings that all runs with a `ScenePrior` share, and the trained prior."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneprior.core.data.dataset import ViewDataset
from sceneprior.core.errors import InputError
from sceneprior.paper.prior import ModelConfig, ScenePrior
from sceneprior.paper.settings import LossConfig, ShapeConfig
from sceneprior.training.method import RunConfig, Trained, ready_copy


class PriorConfig(RunConfig):
    """Settings of a method that trains a `ScenePrior`."""

    model: ModelConfig

    void: ClassVar[bool] = True
    """True if an object may be `void`; see `LayoutDecoder`."""

    @property
    def distribution(self) -> str:
        """Default distribution of new latents."""
        return "paper"

    @property
    def view_terms(self) -> tuple[LossConfig, ShapeConfig | None]:
        """Settings of the view loss for fitting latents to images: its weights, and how shapes are
        rendered (None: not at all).

        They are the paper's defaults, unless the run itself is trained on views.
        """
        return LossConfig(), None

    def build_prior(self) -> ScenePrior:
        """The network, freshly initialised from the seed."""
        torch.manual_seed(self.seed)
        return ScenePrior(self.model, self.classes, self.seed, self.void)

    def build_latents(self, rooms: int) -> nn.Embedding:
        """One row of latent logits per training room, drawn from N(0, 1)."""
        generator = torch.Generator().manual_seed(self.seed + 1)
        logits = torch.randn(rooms, self.model.logits_per_room, generator=generator)
        return nn.Embedding.from_pretrained(logits, freeze=False)

    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        return nn.ModuleDict({"prior": self.build_prior(), "latents": self.build_latents(rooms)})

    def trained(self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]) -> "TrainedPrior":
        prior, latents = networks.prior, networks.latents
        assert isinstance(prior, ScenePrior) and isinstance(latents, nn.Embedding)
        logits = latents.weight.detach().cpu().clone()
        return TrainedPrior(ready_copy(prior), logits, room_ids, self, stage)

    def open_views(self, views_per_room: int, mask_step: int | None) -> ViewDataset:
        """The training rooms with their views; an `InputError` if they do not fit the config."""
        data = self.data
        rooms = ViewDataset(
            Path(data.shards),
            "train",
            views_per_room=views_per_room,
            rotations=data.rotations,
            view_fraction=data.view_fraction,
            mask_step=mask_step,
            seed=self.seed,
        )
        self.check_rooms(rooms, self.model.max_objects)
        return rooms

    def before(self, previous: Path, room_ids: tuple[str, ...]) -> "TrainedPrior":
        """The networks of the previous stage.

        Raises:
            InputError: that stage was trained on other rooms.
        """
        before = self.load(previous.parent.name, previous)
        assert isinstance(before, TrainedPrior)
        if before.room_ids != room_ids:
            raise InputError(
                f"{self.data.shards} no longer holds the rooms of {previous}; every stage of a run "
                "needs the shards that the first was trained on."
            )
        return before


@dataclass(frozen=True)
class TrainedPrior:
    """A trained prior with the latents of its training rooms, ready for use."""

    prior: ScenePrior
    logits: Float[Tensor, "rooms logits"]
    room_ids: tuple[str, ...]
    config: PriorConfig
    stage: str

    @property
    def remembers_rooms(self) -> bool:
        """True if the training rooms' latents are kept."""
        return len(self.logits) > 0

    @property
    def distribution(self) -> str:
        """Default distribution of new rooms."""
        return self.latent_distribution

    @property
    def latent_distribution(self) -> str:
        """Default distribution of new latents: the run's own, or `paper` if the prior lacks the
        latents of its training rooms, as a packed prior may."""
        return self.config.distribution if self.remembers_rooms else "paper"


SHIPPED_WITH_LATENTS = "`demo-bedroom`, which comes with the package and has them"
"""The shipped prior that keeps the latents of its training rooms, for messages."""


def with_training_latents(trained: Trained, purpose: str) -> TrainedPrior:
    """Return `trained` if it keeps the latents of its training rooms.

    Raises:
        InputError: it does not; the message names the `purpose`, and priors that keep them.
    """
    if isinstance(trained, TrainedPrior) and trained.remembers_rooms:
        return trained
    if trained.config.remembers_rooms:
        raise InputError(
            f"{purpose} needs the latents of training rooms, and this prior was packed without "
            "them; take the run that it was packed from, a prior packed with `sceneprior pack "
            f"--latents`, or {SHIPPED_WITH_LATENTS}."
        )
    raise InputError(
        f"{purpose} needs the latents of training rooms, and a run of `method: "
        f"{trained.config.method}` keeps none; take a run of `method: paper` or `method: lifted`."
    )
