"""The prior s = f(z) (Eq. 1): latents z of the hypersphere (section 3.1, Eq. 2), the network that
decodes them, its settings, and the prior as trained."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.core.dataset import ViewDataset
from sceneprior.core.errors import InputError
from sceneprior.core.settings import Section
from sceneprior.core.views import DecodedScenes
from sceneprior.paper.decoders import (
    ClassBevels,
    LayoutDecoder,
    Places,
    ShapeModule,
    ShapeModuleConfig,
)
from sceneprior.paper.transformer import DecoderConfig
from sceneprior.training.method import RunConfig, Trained, ready_copy


class SphereConfig(Section):
    """The paper's hypersphere."""

    name: Literal["sphere"] = "sphere"
    anchors: int = Field(100, ge=2)
    """M, the number of fixed unit vectors of which latents are mixtures; 100 in the authors' code.
    Fewer make new rooms better, and training rooms less exact."""

    def build(self, dimension: int, seed: int) -> "LatentSphere":
        return LatentSphere(self.anchors, dimension, seed)


class CubeConfig(Section):
    """A cube with one logit per coordinate: ablation c1. `distribution: paper` is uniform in it."""

    name: Literal["cube"] = "cube"

    def build(self, dimension: int, seed: int) -> "LatentCube":
        return LatentCube(dimension)


class _Space(nn.Module, ABC):
    @abstractmethod
    def onto(self, points: Tensor) -> Tensor:
        """The nearest point of the latent space to each given point of the surrounding R^D_z."""

    def step(
        self, z: Float[Tensor, "rooms dimension"], length: float, seed: int
    ) -> Float[Tensor, "rooms dimension"]:
        """Move each point by a random step of about `length`; the same seed gives the same
        steps."""
        generator = torch.Generator().manual_seed(seed)
        steps = torch.randn(z.shape, generator=generator).to(z) * (length / z.shape[-1] ** 0.5)
        return self.onto(z + steps)


class LatentSphere(_Space):
    """Map weights w_i of M fixed unit vectors phi_i to a point z of the hypersphere (Eq. 2).

        z = sum_i w_i phi_i / |sum_i w_i phi_i|,    w = softmax(logits)

    Adding a constant to all logits of a room does not change z, hence `shift_free`. `seed`
    determines the anchors phi_i, which are drawn at random and stored with the model.
    """

    shift_free = True

    def __init__(self, anchors: int, dimension: int, seed: int = 0):
        super().__init__()
        self.anchors: Tensor
        generator = torch.Generator().manual_seed(seed)
        # Normalised Gaussians are uniform on the sphere.
        vectors = torch.randn(anchors, dimension, generator=generator)
        self.register_buffer("anchors", F.normalize(vectors, dim=-1))

    def forward(self, logits: Float[Tensor, "rooms anchors"]) -> Float[Tensor, "rooms dimension"]:
        """Latents z of rooms (Eq. 2); the weights w_i are positive and sum to 1."""
        return F.normalize(logits.softmax(dim=-1) @ self.anchors, dim=-1)

    def onto(self, points: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms dimension"]:
        return F.normalize(points, dim=-1)

    def between(
        self,
        start: Float[Tensor, " dimension"],
        end: Float[Tensor, " dimension"],
        along: Float[Tensor, " points"],
    ) -> Float[Tensor, "points dimension"]:
        """The points at places `along` (0 to 1) of the geodesic between two unit vectors (section
        5.3).

        Raises:
            InputError: the two are opposite, so that no geodesic is the shortest.
        """
        # Not acos of the dot product: in float32 it cannot resolve angles between pi - 3e-4 and pi.
        apart, together = (start - end).norm(dim=-1), (start + end).norm(dim=-1)
        angle = 2 * torch.atan2(apart, together)
        if angle > torch.pi - 1e-4:
            raise InputError(
                "The two ends are opposite points of the sphere, and every great circle leads from "
                "one to the other; choose another end, or go by way of a third room."
            )
        t = along.unsqueeze(-1)
        # If the two nearly coincide, sin(angle) vanishes, and the chord replaces the geodesic.
        straight = F.normalize(torch.lerp(start, end, t), dim=-1)
        turned = torch.sin((1 - t) * angle) * start + torch.sin(t * angle) * end
        return torch.where(angle < 1e-3, straight, turned / torch.sin(angle).clamp(min=1e-6))


class LatentCube(_Space):
    """Map one logit per coordinate to a point of a cube around the origin: ablation c1.

        z_i = a * (2 * Phi(logit_i) - 1),    a = sqrt(3 / D_z)

    Phi is the cumulative distribution function of N(0, 1), so logits from N(0, 1) give points that
    are uniform in the cube. The half edge a makes their mean square length 1, the scale of latents
    on the sphere.

    The paper says only 'uniform latent space parameterization'; this is our reading of it.
    """

    shift_free = False

    def __init__(self, dimension: int):
        super().__init__()
        self.half_edge = math.sqrt(3 / dimension)

    def forward(self, logits: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms dimension"]:
        """Points z of the cube; 2 Phi(x) - 1 = erf(x / sqrt(2))."""
        return self.half_edge * torch.erf(logits / math.sqrt(2))

    def onto(self, points: Float[Tensor, "rooms dimension"]) -> Float[Tensor, "rooms dimension"]:
        return points.clamp(-self.half_edge, self.half_edge)

    def between(
        self,
        start: Float[Tensor, " dimension"],
        end: Float[Tensor, " dimension"],
        along: Float[Tensor, " points"],
    ) -> Float[Tensor, "points dimension"]:
        """The points at places `along` (0 to 1) of the straight line between two points."""
        return torch.lerp(start, end, along.unsqueeze(-1))


LatentSpace = LatentSphere | LatentCube


class ModelConfig(Section):
    """The network (section 3 and supplement A). `apps/config.py` lists the choices of `decoder`."""

    max_objects: int = Field(ge=1, le=1000)
    """N, the number of predictions: 13 for bedrooms, 28 for living rooms, 53 for ScanNet. Rooms
    with more objects are refused."""
    width: int = Field(512, ge=8)
    """D_z, the dimension of latents and object features. Wider networks fit more rooms, slower."""
    latent_space: Annotated[SphereConfig | CubeConfig, Field(discriminator="name")] = SphereConfig()
    decoder: DecoderConfig
    layout_heads: Literal["joint", "separate"] = "joint"
    """MLP2 is one MLP for all outputs (`joint`), or as in the released code: a linear layer for the
    classes, separate MLPs for x, y, z, width, height and depth, and one for completeness that reads
    x_k instead of MLP1's output (`separate`)."""
    floor_gradient: bool = False
    """If true, an object that the ReLU of Eq. S1 keeps on the floor can still learn to leave it
    (`above_floor`). With the paper's ReLU (false) it cannot, and lamps may stay on the floor."""
    completeness_target: Literal["first_n", "stop"] = "first_n"
    """Targets of the completeness scores of n objects. `first_n`: 1 for the first n predictions, 0
    after (supplement B). `stop`: 1 from the n-th prediction on; a generated scene then ends with
    its first prediction above 0.5 (main text, released code), and scores beyond the fullest room of
    the batch do not count. Decoding follows the same convention."""
    shape: ShapeModuleConfig

    @model_validator(mode="after")
    def _heads_divide_width(self) -> "ModelConfig":
        heads = getattr(self.decoder, "heads", 1)
        if self.width % heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {heads}")
        return self

    @property
    def logits_per_room(self) -> int:
        """Number of learnt logits per room."""
        space = self.latent_space
        return space.anchors if isinstance(space, SphereConfig) else self.width


class ScenePrior(nn.Module):
    """The mapping s = f(z) from the latent space to scenes (Eq. 1).

    `seed` determines the anchors of the latent sphere; `void` is explained in `LayoutDecoder`.
    """

    def __init__(self, config: ModelConfig, classes: int, seed: int = 0, void: bool = True):
        super().__init__()
        width = config.width
        self.max_objects = config.max_objects
        self.latent_space: LatentSpace = config.latent_space.build(width, seed)
        self.decoder = config.decoder.build(width, config.max_objects)
        self.layout = LayoutDecoder(
            width, classes, config.layout_heads, void, config.floor_gradient
        )
        self.bevels = ClassBevels(classes)
        self.shape: ShapeModule = config.shape.build(2 * width)

    @property
    def by_class(self) -> str | None:
        """Pattern of the names of tensors with rows by class; None if prototypes have classes."""
        pattern = r"\.(layout\.mlp2\.(3|classes)\.(weight|bias)|bevels\.logits)$"
        return None if self.shape.faces is None else pattern

    def forward(
        self, logits: Float[Tensor, "rooms logits"], with_shape: bool = True
    ) -> DecodedScenes:
        """Decode rooms from the logits of their latent weights."""
        return self.decode(self.latent_space(logits), with_shape)

    def decode(
        self,
        z: Float[Tensor, "rooms width"],
        with_shape: bool | Places = True,
        wanted: Bool[Tensor, "rooms wanted"] | None = None,
    ) -> DecodedScenes:
        """Decode rooms from points of the latent space; `with_shape` adds shapes.

        If `with_shape` is not a bool, it holds the indices (room, object) of the objects that get a
        mesh; all vertices of the others lie at the centre of their box. `wanted` limits what is
        decoded: as many predictions as it has columns, and meshes only where it is true.
        Predictions after a room's last true entry are meaningless. None decodes all N.
        """
        count = self.max_objects if wanted is None else wanted.shape[1]
        needed = None
        if wanted is not None:
            numbers = torch.arange(1, wanted.shape[1] + 1, device=wanted.device)
            needed = (wanted * numbers).amax(dim=1)
        scenes, shared = self.layouts(z, count, needed)
        return self.shape.add_shapes(scenes, shared, with_shape, wanted)

    def layouts(
        self,
        z: Float[Tensor, "rooms width"],
        objects: int,
        needed: Int[Tensor, " rooms"] | None = None,
    ) -> tuple[DecodedScenes, Float[Tensor, "rooms objects features"]]:
        """Decode rooms without shapes, and the features from which shapes are decoded.

        Layouts stay float32 under autocast: bfloat16 would round 3 m to steps of 2 cm.
        """
        features = self.decoder(z, objects, needed)
        with torch.autocast(z.device.type, enabled=False):
            scenes, shared = self.layout(features.to(z.dtype))
        return replace(scenes, bevels=self.bevels(scenes.class_logits)), shared


class PriorConfig(RunConfig):
    """Settings of a method that trains a `ScenePrior`."""

    model: ModelConfig

    void: ClassVar[bool] = True
    """True if an object may be `void`; see `LayoutDecoder`."""

    @property
    def distribution(self) -> str:
        """Default distribution of new latents."""
        return "paper"

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
        return TrainedPrior(ready_copy(prior), room_ids, self, stage, logits)

    def open_views(
        self, views_per_room: int, mask_step: int | None, split: str = "train"
    ) -> ViewDataset:
        """The rooms of a split with their views; an `InputError` if they do not fit the config."""
        data = self.data
        rooms = ViewDataset(
            Path(data.shards),
            split,
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
class TrainedPrior(Trained):
    """A trained prior with the latents of its training rooms, ready for use."""

    prior: ScenePrior
    config: PriorConfig
    logits: Float[Tensor, "rooms logits"]

    @property
    def remembers_rooms(self) -> bool:
        return len(self.logits) > 0

    @property
    def distribution(self) -> str:
        return self.latent_distribution

    @property
    def latent_distribution(self) -> str:
        """Default distribution of new latents: `kernel` if it is the run's own and the latents of
        its training rooms are kept, as a packed prior may not; else `paper`."""
        kernel = self.remembers_rooms and self.config.distribution == "kernel"
        return "kernel" if kernel else "paper"
