"""The protocol of a method (`RunConfig`), and what training gives back.

A method's config adds its own sections to `RunConfig` and implements `stages` (what `fit` trains),
`networks` (what a checkpoint fills) and `trained` (a stage's networks, ready for use). The paper's
method is `training/ours.py`, baselines have theirs; `config.py` lists all.
"""

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, Protocol, runtime_checkable

import torch
from jaxtyping import Float
from pydantic import Field, model_validator
from torch import Tensor, nn

from sceneprior.classes import label_set
from sceneprior.data.dataset import ViewDataset
from sceneprior.errors import InputError
from sceneprior.lifting.dataset import LiftedDataset
from sceneprior.lifting.lifted import ShapeGrid
from sceneprior.models.prior import ModelConfig, ScenePrior
from sceneprior.sampler.network import RoomSampler
from sceneprior.scene import Mesh
from sceneprior.settings import Section
from sceneprior.shards import Shard, list_shards
from sceneprior.training.checkpoints import read_networks
from sceneprior.training.settings import DataConfig, SamplesConfig, TrainConfig
from sceneprior.views import RoomBoxes, SceneViews

if TYPE_CHECKING:
    import lightning

OF_SHARDS = "shards"
"""In place of a label set's name: whatever the training rooms are labelled with."""


@dataclass(frozen=True)
class Stage:
    """One LightningModule to train. It has the network as `prior`, and `latents` if any."""

    name: str
    """The stage's folder in the run."""
    settings: TrainConfig
    open_data: Callable[[], Any]
    """Opens the training rooms: a `ViewDataset`, a `LiftedDataset`, `SamplerRooms`, or a
    `TruthDataset`."""
    build: Callable[[Any, Path | None], "lightning.LightningModule"]
    """Makes the module from these rooms and the checkpoint of the stage before."""
    steps_itself: bool = False
    """The module has several optimisers and steps them: in one process, without accumulation."""


class RunConfig(Section, ABC):
    """What a run of any method is; saved with it as `config.yaml`."""

    method: str
    label_set: str = OF_SHARDS
    """`shards`: that of `data.shards`, which `fit` writes here; or a name in
    `sceneprior/classes.py`, or the user's own list, `void,bed,chair`: no other shards will do."""
    seed: int = Field(0, ge=0)
    data: DataConfig
    samples: SamplesConfig = SamplesConfig()

    remembers_rooms: ClassVar[bool] = False
    """Whether training rooms have latents of their own."""

    @model_validator(mode="after")
    def _known_label_set(self) -> "RunConfig":
        try:
            if self.label_set != OF_SHARDS:
                label_set(self.label_set)
        except InputError as error:
            raise ValueError(f"label_set: {str(error).removesuffix('.')}") from None
        return self

    def with_label_set(self) -> "RunConfig":
        """The same with the label set of `data.shards` where it is left to them.

        Raises:
            ShardError: it is, and there are none to train on.
        """
        if self.label_set != OF_SHARDS:
            return self
        with Shard(list_shards(Path(self.data.shards), "train")[0]) as shard:
            return self.model_copy(update={"label_set": shard.label_set})

    @property
    def classes(self) -> int:
        """Size of the label set."""
        return len(label_set(self.label_set))

    @abstractmethod
    def stages(self) -> tuple[Stage, ...]:
        """What is trained, in order."""

    @property
    def stage_names(self) -> tuple[str, ...]:
        """Names of the stages, which are also their folders, in order."""
        return tuple(stage.name for stage in self.stages())

    @abstractmethod
    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        """What tasks take out of a stage's checkpoint of so many rooms, freshly initialised from
        the seed: `prior`, and `latents` and `sampler` if any."""

    @abstractmethod
    def trained(self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]) -> "Trained":
        """A copy of a module's networks as they stand, on the CPU and in evaluation mode."""

    def load(self, stage: str, path: Path) -> "Trained":
        """What a checkpoint of a stage holds, in evaluation mode.

        Raises:
            InputError: it is damaged, or of another network.
        """
        networks, room_ids = read_networks(path, partial(self.networks, stage))
        return self.trained(networks, stage, room_ids)

    def check_rooms(self, rooms: Any, max_objects: int | None) -> None:
        """Refuse training rooms that do not fit.

        Raises:
            InputError: another label set, or more objects than the network generates.
        """
        shards = self.data.shards
        if rooms.label_set != self.label_set:
            raise InputError(
                f"{shards} is labelled '{rooms.label_set}' but the config says "
                f"'{self.label_set}'; set label_set=shards or point data.shards elsewhere."
            )
        if max_objects is not None and rooms.max_objects > max_objects:
            raise InputError(
                f"A room of {shards} has {rooms.max_objects} {rooms.counted} but "
                f"model.max_objects is {max_objects}; raise it."
            )


class PriorConfig(RunConfig):
    """A method that trains a `ScenePrior`."""

    model: ModelConfig

    void: ClassVar[bool] = True
    """Whether an object may be `void`; see `LayoutDecoder`."""

    @property
    def distribution(self) -> str:
        """Where new latents come from unless a task says otherwise."""
        return "paper"

    def build_prior(self) -> ScenePrior:
        """The network, freshly initialised from the seed."""
        torch.manual_seed(self.seed)
        return ScenePrior(self.model, self.classes, self.seed, self.void)

    def build_latents(self, rooms: int) -> nn.Embedding:
        """One row of latent logits a training room, drawn from N(0, 1)."""
        generator = torch.Generator().manual_seed(self.seed + 1)
        logits = torch.randn(rooms, self.model.logits_per_room, generator=generator)
        return nn.Embedding.from_pretrained(logits, freeze=False)

    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        return nn.ModuleDict({"prior": self.build_prior(), "latents": self.build_latents(rooms)})

    def trained(self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]) -> "TrainedPrior":
        prior, latents = networks.prior, networks.latents
        assert isinstance(prior, ScenePrior) and isinstance(latents, nn.Embedding)
        logits = latents.weight.detach().cpu().clone()
        sampler = ready_copy(networks.sampler) if hasattr(networks, "sampler") else None
        return TrainedPrior(ready_copy(prior), logits, room_ids, self, stage, sampler)

    def open_views(self, views_per_room: int, mask_step: int | None) -> ViewDataset:
        """The training rooms; InputError if they do not fit the config."""
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

    def open_lifted(self, shape: ShapeGrid | None = None, split: str = "train") -> LiftedDataset:
        """Rooms with 3D boxes found from their masks, and perhaps grids of shapes; InputError as
        above."""
        data = self.data
        rooms = LiftedDataset(
            Path(data.shards),
            split,
            rotations=data.rotations,
            view_fraction=data.view_fraction,
            shape=shape,
            seed=self.seed,
        )
        self.check_rooms(rooms, self.model.max_objects)
        return rooms


LATENTS_BESIDE = "kernel"
"""The distribution of latents of a run whose new rooms come from its sampler."""


@dataclass(frozen=True)
class TrainedPrior:
    """A prior with the latents of the rooms it was trained on, ready for use."""

    prior: ScenePrior
    logits: Float[Tensor, "rooms logits"]
    room_ids: tuple[str, ...]
    config: PriorConfig
    stage: str
    sampler: RoomSampler | None = None
    """What makes new rooms without a latent; None before its stage, and where there is none."""

    @property
    def remembers_rooms(self) -> bool:
        """Whether training rooms have latents of their own."""
        return len(self.logits) > 0

    @property
    def distribution(self) -> str:
        """Where new rooms come from unless a task says otherwise: as the config says; before the
        stage of the sampler that it names, from `latent_distribution`."""
        with_sampler = self.sampler is not None and self.config.distribution == "sampler"
        return "sampler" if with_sampler else self.latent_distribution

    @property
    def latent_distribution(self) -> str:
        """Where new latents come from, which a sampler does without; all but `paper` need those of
        training rooms, which a packed prior may lack."""
        if not self.remembers_rooms:
            return "paper"
        asked = self.config.distribution
        return asked if asked != "sampler" else LATENTS_BESIDE


@runtime_checkable
class BoxSampler(Protocol):
    """A network that makes rooms of labelled boxes from a seed alone."""

    def sample(self, count: int, seed: int) -> RoomBoxes:
        """New rooms. The same seed gives the same rooms, the first of them however many follow."""

    def parameters(self) -> Any: ...


@dataclass(frozen=True)
class TrainedSampler:
    """A trained method that makes rooms of boxes from a seed alone: no room has a latent, and no
    object a mesh."""

    prior: BoxSampler
    room_ids: tuple[str, ...]
    config: RunConfig
    stage: str

    remembers_rooms = False

    @property
    def distribution(self) -> str:
        """Where new rooms come from: the method itself."""
        return self.config.method


class FoundObject(NamedTuple):
    """What is found in 3D for a mask, in the room frame."""

    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    mesh: Mesh


@runtime_checkable
class ViewReconstructor(Protocol):
    """A network that answers images directly, object by object."""

    def find(self, views: SceneViews) -> list[list[FoundObject]]:
        """Of each image (a room of one view), what each of its masks is of, in their order."""

    def parameters(self) -> Any: ...


@dataclass(frozen=True)
class TrainedReconstructor:
    """A trained method that answers images and does nothing else: it makes no new rooms."""

    prior: ViewReconstructor
    room_ids: tuple[str, ...]
    config: RunConfig
    stage: str

    remembers_rooms = False
    distribution = "none"
    """It makes no new rooms."""


Trained = TrainedPrior | TrainedSampler | TrainedReconstructor


def ready_copy(network: Any) -> Any:
    """A copy of a network on the CPU, in evaluation mode and without gradients."""
    return copy.deepcopy(network).cpu().eval().requires_grad_(False)
