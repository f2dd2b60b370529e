"""The interface of a method (`RunConfig`), its trained networks (`Trained`), and a run's folder.

A method's config adds its own sections to `RunConfig` and implements `stages` (the LightningModules
that `fit` trains), `networks` (the modules that a checkpoint's weights are loaded into) and
`trained` (a stage's networks, ready for use). The paper's method is in `paper/config.py`, the
baselines have their own; `apps/config.py` lists all.

RUN/config.yaml            all settings, defaults included
RUN/<stage>/last.ckpt      the stage's newest checkpoint, from which `--resume` continues
RUN/<stage>/best.ckpt      the epoch with the least val/loss
RUN/<stage>/final.ckpt     the finished stage, which commands load
RUN/<stage>/metrics.csv    one line per epoch and validation; TensorBoard's files are beside it
"""

import contextlib
import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, Protocol, runtime_checkable

import torch
from pydantic import Field, model_validator
from torch import nn

from sceneprior.core.classes import label_set
from sceneprior.core.errors import ConfigError, InputError, cause_of, shortened
from sceneprior.core.files import check_file, read_table, reading
from sceneprior.core.repeatable import LARGEST_SEED
from sceneprior.core.scene import Mesh
from sceneprior.core.settings import Section
from sceneprior.core.shards import Shard, list_shards
from sceneprior.core.views import RoomBoxes, SceneViews

if TYPE_CHECKING:
    import lightning


OF_SHARDS = "shards"
"""Placeholder for a label set's name: the label set of the training shards."""


class DataConfig(Section):
    """The shards, and the part of each room that training uses."""

    shards: str
    """Folder of view shards (any `prep-*` command); relative to the current folder."""
    view_fraction: float = Field(1.0, gt=0, le=1)
    """Share of each room's views that training may use (the paper's Table 4: 0.25, 0.5, 1);
    validation takes the others."""
    augment_rotations: bool = True
    """Add each room rotated by 90, 180 and 270 degrees, each with its own latent."""
    mask_step: int = Field(4, ge=1)
    """Masks are compared at 1 / mask_step of the rendered resolution (paper: 4). A larger step is
    faster, and loses thin objects."""
    workers: int = Field(0, ge=0)
    """Loader processes; 0 loads in the training process, which is fastest for small sets."""

    @property
    def rotations(self) -> int:
        """Number of data set rows per room: 4 with augmentation, else 1."""
        return 4 if self.augment_rotations else 1


class ViewDataConfig(DataConfig):
    """The shards, and the number of views of each room that a step uses."""

    views_per_room: int = Field(20, ge=1)
    """Views drawn per room and step (paper: 20), unless a stage overrides it. More give smoother
    gradients; a step's time and memory grow with them."""


class TrainConfig(Section):
    """Training settings that the stages of all methods share. The optimiser is Adam."""

    epochs: int = Field(ge=1)
    """Passes over the training rooms; `--resume` accepts a larger number (docs/training.md)."""
    batch_size: int = Field(16, ge=1)
    """Rooms per batch and process. A larger batch gives fewer, smoother updates per epoch."""
    accumulate: int = Field(1, ge=1)
    """Batches whose gradients are averaged before each update, which takes no more memory."""
    clip_gradient: float = Field(0.0, ge=0)
    """Norm to which gradients are clipped, against jumps of the loss; 0 turns clipping off."""
    cpu_threads: int | None = Field(None, ge=1)
    """Torch threads on a CPU; None is 1. A second one changes the last bits of weights, speeds up a
    small network little, and slows it down much when another program uses that core."""
    val_every: int = Field(20, ge=0)
    """Epochs between validations, besides one after the last epoch; 0 turns validation off."""
    keep: Literal["last", "best", "lowest"] = "last"
    """Weights that the next stage and commands take: those of the `last` epoch, or best.ckpt, which
    is the epoch with the least `val/loss` (`best`) or `train/loss` (`lowest`, as the released code
    does)."""


def without_samples(data: dict[str, Any], source: str) -> dict[str, Any]:
    """The settings of a run without the section `samples`, which runs had until version 0.1.0."""
    samples = data.get("samples", {})
    every = samples.get("every", 0) if isinstance(samples, dict) else samples
    if every != 0:
        raise ConfigError(
            f"{source}: 'samples.every' is {shortened(every)}, but training no longer evaluates "
            "generated rooms; delete the section `samples`. The run's final.ckpt is read as before."
        )
    return {key: value for key, value in data.items() if key != "samples"}


@dataclass(frozen=True)
class Stage:
    """A LightningModule to train, and its training data. The module's attribute `prior` is the
    network; `latents`, if present, is the table of the rooms' latents."""

    name: str
    """Name of the stage, and of its folder in the run."""
    settings: TrainConfig
    open_data: Callable[[], Any]
    """Opens the training rooms: a `ViewDataset`, `LiftedDataset`, `SamplerRooms` or
    `TruthDataset`."""
    build: Callable[[Any, Path | None], "lightning.LightningModule"]
    """Builds the module from these rooms and the checkpoint of the previous stage."""
    open_val: Callable[[], Any] | None = None
    """Opens the val rooms in the same way; None for a stage that is not validated on them."""
    steps_itself: bool = False
    """True for a module that steps its own optimisers; it trains in one process, without
    accumulation."""


class RunConfig(Section, ABC):
    """Settings of a run of any method, saved with it as `config.yaml`."""

    method: str
    label_set: str = OF_SHARDS
    """`shards`: the label set of `data.shards`, which `fit` writes here. Otherwise a name in
    `core/classes.py`, or the user's own list, such as `void,bed,chair`; shards with another label
    set are refused."""
    seed: int = Field(0, ge=0, le=LARGEST_SEED)
    """Seed of initial weights and latents, of batches, views, noise and dropout."""
    data: DataConfig
    init_from: str | None = None
    """Run folder or checkpoint whose weights replace the random ones at the start of the first
    stage. Classes of another label set are matched by name, and latents by the ids of rooms."""
    trainer: dict[str, Any] = Field({})
    """Arguments of Lightning's Trainer that no section of a stage sets, such as {max_steps: 9}."""
    callbacks: tuple[dict[str, dict[str, Any] | None], ...] = Field((), strict=False)
    """Lightning callbacks for every stage, each as {class path: arguments}."""
    logger: dict[Literal["csv", "tensorboard", "wandb"], dict[str, Any]] = Field({})
    """Arguments of Lightning's loggers, such as {wandb: {project: rooms, tags: [small]}}."""

    remembers_rooms: ClassVar[bool] = False
    """True if each training room has its own latent."""

    @property
    def learns_from(self) -> str:
        """Description of the supervision that training uses."""
        return "masks in 2D"

    @model_validator(mode="after")
    def _known_label_set(self) -> "RunConfig":
        try:
            if self.label_set != OF_SHARDS:
                label_set(self.label_set)
        except InputError as error:
            raise ValueError(f"label_set: {str(error).removesuffix('.')}") from None
        return self

    def with_label_set(self) -> "RunConfig":
        """The same config, with `shards` replaced by the label set of `data.shards`."""
        if self.label_set != OF_SHARDS:
            return self
        with Shard(list_shards(Path(self.data.shards), "train")[0]) as shard:
            return self.model_copy(update={"label_set": shard.label_set})

    @property
    def classes(self) -> int:
        """Number of classes in the label set."""
        return len(label_set(self.label_set))

    @abstractmethod
    def stages(self) -> tuple[Stage, ...]:
        """The stages to train, in order."""

    @property
    def stage_names(self) -> tuple[str, ...]:
        """Names of the stages, which are also their folders, in order."""
        return tuple(stage.name for stage in self.stages())

    @abstractmethod
    def networks(self, stage: str, rooms: int) -> nn.ModuleDict:
        """Build the modules that commands load from a stage's checkpoint: `prior`, and `latents`
        and `sampler` if any. They are freshly initialised from the seed; `rooms` is the number of
        training rooms."""

    @abstractmethod
    def trained(self, networks: nn.Module, stage: str, room_ids: tuple[str, ...]) -> "Trained":
        """A copy of a module's current networks, on the CPU and in evaluation mode."""

    def load(self, stage: str, path: Path) -> "Trained":
        """The networks in a stage's checkpoint, in evaluation mode."""
        saved = read_checkpoint(path)
        try:
            room_ids = tuple(saved["sceneprior"]["room_ids"])
            networks = self.networks(stage, len(room_ids))
            # Weights used only in training, such as a discriminator's, are left out.
            weights = {k: v for k, v in saved["state_dict"].items() if k.split(".")[0] in networks}
            networks.load_state_dict(weights)
        except InputError:
            raise
        except Exception as error:  # the error depends on where the wrong part is first used
            raise InputError(
                f"{path} does not fit the run's config.yaml ({cause_of(error)}); use the "
                "config it was trained with."
            ) from None
        return self.trained(networks, stage, room_ids)

    def check_rooms(self, rooms: Any, max_objects: int | None) -> None:
        """Check that training rooms fit the config."""
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


@dataclass(frozen=True)
class Trained:
    """Networks of a run, ready for use; each kind of method has its own subclass."""

    prior: Any
    """The network."""
    room_ids: tuple[str, ...]
    """Ids of the training rooms."""
    config: RunConfig
    stage: str
    """The stage that was trained last."""

    @property
    def remembers_rooms(self) -> bool:
        """True if each training room has its own latent."""
        return False

    @property
    def distribution(self) -> str:
        """Default distribution of new rooms; without latents, the name of the method."""
        return self.config.method


@runtime_checkable
class BoxSampler(Protocol):
    """A network that generates rooms of labelled boxes from a seed alone."""

    def sample(self, count: int, seed: int) -> RoomBoxes:
        """New rooms. The same seed gives the same rooms, and the first ones do not depend on
        `count`."""

    def parameters(self) -> Any: ...


class TrainedSampler(Trained):
    """A trained method that generates rooms of boxes from a seed alone: its rooms have no latents,
    and its objects no meshes."""

    prior: BoxSampler


class FoundObject(NamedTuple):
    """The 3D object reconstructed for a mask, in the room frame."""

    center_m: tuple[float, float, float]
    size_m: tuple[float, float, float]
    mesh: Mesh


@runtime_checkable
class ViewReconstructor(Protocol):
    """A network that reconstructs images directly, object by object."""

    def find(self, views: SceneViews) -> list[list[FoundObject]]:
        """Find the objects of each image, one per mask, in the order of the masks.

        An image is a room of `views` with a single view.
        """

    def parameters(self) -> Any: ...


class TrainedReconstructor(Trained):
    """A trained method that only reconstructs images: it generates no new rooms."""

    prior: ViewReconstructor
    distribution = "none"


def ready_copy(network: Any) -> Any:
    """A copy of a network on the CPU, in evaluation mode and without gradients."""
    return copy.deepcopy(network).cpu().eval().requires_grad_(False)


def find_checkpoint(run: Path, stages: Sequence[str]) -> tuple[str, Path]:
    """Stage and path of the checkpoint that commands load; `stages` are the run's, in order.

    The last finished stage is chosen; if no stage is finished, the newest checkpoint of the last
    stage begun.
    """
    for name in ("final.ckpt", "last.ckpt"):
        for stage in reversed(stages):
            if (run / stage / name).is_file():
                return stage, run / stage / name
    raise InputError(
        f"{run} holds no checkpoint yet; continue its training with `sceneprior fit --config "
        f"{run / 'config.yaml'} --run {run} --resume`."
    )


def read_metrics(path: Path) -> list[dict[str, str]]:
    """Rows of a stage's metrics.csv, if any, by column; a row cut off by a kill is left out."""
    header, *rows = (read_table(path) if path.is_file() else []) or [[]]
    found = []
    for row in rows:
        with contextlib.suppress(LookupError, ValueError, OverflowError):
            cells = dict(zip(header, row, strict=True))
            int(cells["epoch"]), [float(cell or 0) for cell in row]
            found.append(cells)
    return found


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The contents of a checkpoint: tensors and plain data only."""
    check_file(path)
    then = "; it is damaged. Delete it and run `sceneprior fit` with `--resume`."
    with reading(path, then=then):
        saved = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(saved, dict) or not isinstance(saved.get("state_dict"), dict):
        raise InputError(
            f"{path} is not a checkpoint of `sceneprior fit` (it has no state_dict). Delete it and "
            "run `sceneprior fit` with `--resume`."
        )
    return saved
