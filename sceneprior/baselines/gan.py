"""The GAN baseline: the paper's network, trained by a discriminator of semantic maps."""

import copy
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.core.optimizer import LightningOptimizer
from pydantic import Field
from torch import Tensor
from torch.nn import functional as F
from torch.optim.swa_utils import get_ema_multi_avg_fn

from sceneprior.baselines.semantic_maps import (
    MapDiscriminator,
    adversarial_loss,
    choices,
    contents,
    observed_counts,
    observed_maps,
    rendered_maps,
)
from sceneprior.core.cameras import camera_centers
from sceneprior.core.classes import VOID
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.decoders import LayoutDecoder, ShapeDecoderConfig
from sceneprior.paper.prior import ModelConfig, PriorConfig
from sceneprior.paper.sampling import example_rooms
from sceneprior.paper.transformer import TransformerConfig
from sceneprior.training.method import Stage, TrainConfig
from sceneprior.training.steps import check_finite, full_precision, log_losses

BETAS = (0.0, 0.99)
"""Betas of both Adam optimisers. There is no momentum, because it would average gradients against
earlier states of the other network."""
STARTS = ((0.0, 1.2), (0.4, 0.4), (0.0, 1.2), (0.4, 0.5), (0.4, 0.5), (0.4, 0.5), (1.5, 1.0))
"""Mean and standard deviation, over rooms and objects, of the untrained layout decoder's outputs:
x, y, z in metres, width, height, depth before their SoftPlus, and completeness."""
START_ROOMS = 64
"""Number of random rooms over which the outputs are set to `STARTS`."""
SHAPE_RATE = 0.1
"""Learning rate of the shape decoder, relative to the generator's. It is low, because semantic maps
do not rule out sheared boxes."""
LOGIT_PENALTY = 0.01
"""Weight of `logit_penalty`. Without it, choices could become almost certain and lose their
gradient, and a generator that has lost all objects could not recover."""
BOUNDS_PENALTY = 10.0
"""Weight of `bounds_penalty`."""
VARIED = (1.5, 1.5, 0.3, 0.3, 0.3)
"""Target standard deviation over rooms, in metres, of the k-th object's x, z, width, height and
depth."""
MARGIN_M, CEILING_M = 0.5, 3.0
"""Bounds of generated boxes in metres. Along x and z, they are `MARGIN_M` beyond the batch's
furthest camera from the floor centre; along y, they are the floor and `CEILING_M`."""
SIZES_M = (0.1, 2.5)
"""Bounds of generated sizes in metres."""
MEMORY = 0.9
"""Decay per step of the running mean `excess`. A single batch has too few objects of rare
classes."""


class GanTraining(TrainConfig):
    """Settings of the training; docs/baselines_2d.md explains each.

    Maps have half the height and width of the instance ids that `data.mask_step` gives.
    """

    epochs: int = Field(400, ge=1)
    batch_size: int = Field(16, ge=1)
    """Number of real rooms per step; equally many rooms are generated."""
    accumulate: Literal[1] = 1
    """Every batch updates both networks."""
    views_per_room: int = Field(4, ge=1)
    """Views of each real and generated room per step."""
    learning_rate: float = Field(1e-3, gt=0)
    """Learning rate of the generator, whose shape decoder learns at a tenth of it."""
    discriminator_learning_rate: float = Field(4e-3, gt=0)
    """Learning rate of the discriminator. If it is too large, the discriminator is always right and
    its gradient vanishes; if too small, the generator exploits the discriminator's errors."""
    counts: float = Field(1.0, ge=0)
    """Weight of the loss that matches each class's mean number of objects and pixels to real rooms.
    At 0, class frequencies drift."""
    variety: float = Field(4.0, ge=0)
    """Weight of `diversity_loss`. If it is too small, all rooms become the same; if too large,
    positions become random."""
    averaging: float = Field(0.97, ge=0, lt=1)
    """Decay of the generator's running average per step; 0 uses the newest weights."""
    noise: float = Field(0.1, ge=0)
    """Standard deviation of the noise on all maps at the start; it falls to 0 over the epochs.
    Without it, classes can be lost permanently."""
    clip_gradient: float = Field(1.0, ge=0)
    """Maximum gradient norm of each network; 0 turns clipping off."""
    silhouettes: Literal["exact", "fast"] = "fast"
    """`exact`: every face near a pixel counts; `fast`: the outline alone, in less time."""


class GanModel(ModelConfig):
    """The paper's network with meshes as shapes, from which the maps are rendered."""

    decoder: TransformerConfig = TransformerConfig()
    shape: ShapeDecoderConfig = ShapeDecoderConfig()


class GanConfig(PriorConfig):
    """Config of a run of the GAN, whose objects are never void (docs/baselines_2d.md)."""

    method: Literal["gan"] = "gan"
    model: GanModel
    training: GanTraining = GanTraining()

    void: ClassVar[bool] = False

    def stages(self) -> tuple[Stage, ...]:
        views = partial(self.open_views, self.training.views_per_room, self.data.mask_step)
        return (Stage("gan", self.training, views, self._build, steps_itself=True),)

    def _build(self, rooms: ViewDataset, previous: Path | None) -> "GanStage":
        return GanStage(self)


class GanStage(lightning.LightningModule):
    """Updates the discriminator and the generator once per batch (supplement, Baselines).

    For each room of the batch a new one is generated, from logits drawn from N(0, 1), and rendered
    as semantic maps in that room's cameras. Generated and real rooms are not paired, so training
    rooms have no latents. docs/baselines_2d.md lists what keeps the training stable.

    `generator` is trained; `prior`, which tasks load from checkpoints, is a running average of its
    weights, in which the oscillation of the two networks cancels. `excess` is the running mean of
    `contents` of generated rooms minus that of real rooms.
    """

    examples = staticmethod(example_rooms)

    def __init__(self, config: GanConfig):
        super().__init__()
        self.automatic_optimization = False
        self.model, self.settings = config.model, config.training
        self.classes = config.classes
        self.generator = prior = config.build_prior()
        spread_out(prior.layout, prior.decoder(self._latents(START_ROOMS), prior.max_objects))
        self.prior = copy.deepcopy(prior).requires_grad_(False)
        self.average = get_ema_multi_avg_fn(config.training.averaging)
        # No room has a latent; the empty table keeps the checkpoint format of all priors.
        self.latents = config.build_latents(0)
        self.discriminator = MapDiscriminator(self.classes)
        self.excess: Tensor
        self.register_buffer("excess", torch.zeros(2 * self.classes))

    def training_step(self, views: SceneViews, batch_idx: int) -> None:
        generator_optimizer, discriminator_optimizer = self.optimizers()  # type: ignore[attr-defined]
        scenes = self.generator.decode(self._latents(len(views.room_index)))
        with full_precision(self.device):
            # This is checked before rendering, which rejects vertices that are not finite.
            undecided = logit_penalty(scenes)
            check_finite(undecided + scenes.centers_m.sum() + scenes.sizes_m.sum(), views.room_ids)
            real = observed_maps(views, self.classes)
            kept, chosen = choices(scenes, self.model.completeness_target)
            faces = self.generator.shape.faces
            assert faces is not None, "GanModel has meshes"
            fake = rendered_maps(scenes, faces, views, kept, chosen, self.settings.silhouettes)
            counts = (kept.unsqueeze(-1) * chosen).sum(dim=1)
            more = contents(fake, counts) - contents(real, observed_counts(views, self.classes))
            self.excess.lerp_(more.detach().mean(dim=0), 1 - MEMORY)
            loss = LOGIT_PENALTY * undecided + BOUNDS_PENALTY * bounds_penalty(scenes, views)
            loss = loss + self.settings.variety * diversity_loss(scenes)
            loss = loss + self.settings.counts * (more @ self.excess).mean()

        # Pooled real maps have few distinct values, rendered ones many; noise hides this.
        noise = self.settings.noise * self._left()
        real, fake = (maps + noise * torch.randn_like(maps) for maps in (real, fake))
        real_scores = self.discriminator(real)
        fake_scores = self.discriminator(fake.detach())
        discriminator_loss = adversarial_loss(real_scores, real=True) + adversarial_loss(
            fake_scores, real=False
        )
        self._update(discriminator_optimizer, discriminator_loss)

        self.discriminator.requires_grad_(False)
        loss = loss + adversarial_loss(self.discriminator(fake), real=True)
        check_finite(loss, views.room_ids)
        self._update(generator_optimizer, loss)
        self.discriminator.requires_grad_(True)
        self.average(list(self.prior.parameters()), list(self.generator.parameters()), 0)
        logged = {
            "discriminator": discriminator_loss,
            "real_score": torch.stack([score.mean() for score in real_scores]).mean(),
            "fake_score": torch.stack([score.mean() for score in fake_scores]).mean(),
            "objects": counts.sum(dim=1).mean(),
        }
        log_losses(self, logged, loss, len(counts))

    def on_train_epoch_start(self) -> None:
        """Reduce the rates linearly to 0, which ends the oscillation of the two networks."""
        for optimizer in self.optimizers():  # type: ignore[union-attr]
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"] * self._left()

    def _left(self) -> float:
        """Share of the epochs that remain."""
        return 1 - self.current_epoch / self.settings.epochs

    def _latents(self, rooms: int) -> Float[Tensor, "rooms width"]:
        shape = (rooms, self.model.logits_per_room)
        with full_precision(self.device):
            return self.generator.latent_space(torch.randn(shape, device=self.device))

    def _update(self, optimizer: LightningOptimizer, loss: Tensor) -> None:
        optimizer.zero_grad()
        self.manual_backward(loss)
        self.clip_gradients(optimizer, self.settings.clip_gradient, "norm")  # type: ignore[arg-type]
        optimizer.step()

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        rates = self.settings
        shape = list(self.generator.shape.parameters())
        others = [p for name, p in self.generator.named_parameters() if "shape." not in name]
        networks = (
            ((others, rates.learning_rate), (shape, SHAPE_RATE * rates.learning_rate)),
            ((self.discriminator.parameters(), rates.discriminator_learning_rate),),
        )
        return [
            torch.optim.Adam(
                [{"params": own, "lr": rate, "initial_lr": rate} for own, rate in parts],
                betas=BETAS,
            )
            for parts in networks
        ]


@torch.no_grad()
def spread_out(layout: LayoutDecoder, features: Float[Tensor, "rooms objects width"]) -> None:
    """Initialise the layout decoder so that objects differ in position, size and class.

    An untrained layout decoder puts all objects at the floor centre with the same class, and the
    discriminator would move them all alike. So the decoder's last layer is scaled and shifted until
    each output, over the objects with the given `features`, has the mean and standard deviation in
    `STARTS`; class logits get mean 0 and deviation 1.

    Source: Salimans and Kingma, "Weight normalization", NeurIPS 2016, section 3.
    """
    outputs = layout.mlp2(layout.mlp1(features), features).flatten(0, 1)
    starts = [(0.0, 1.0)] * layout.classes + list(STARTS)
    rows = zip(layout.mlp2.rows(), outputs.unbind(dim=1), starts, strict=True)
    for (weight, bias), values, (mean, spread) in rows:
        scale = spread / values.std()
        weight *= scale
        bias.copy_(mean + scale * (bias - values.mean()))


def bounds_penalty(scenes: DecodedScenes, views: SceneViews) -> Float[Tensor, ""]:
    """Mean distance in metres by which boxes exceed the room's bounds and sizes exceed `SIZES_M`.

    In a map, a bed looks the same as a huge bed behind the room. Objects that no view shows get no
    other gradient, so without this penalty they would not return to the room.
    """
    reach = camera_centers(views.world_to_camera).abs().amax(dim=(0, 1)) + MARGIN_M
    reach[1] = CEILING_M / 2
    aside = scenes.centers_m - reach.new_tensor([0, CEILING_M / 2, 0])
    smallest, largest = SIZES_M
    outside = (
        F.relu(aside.abs() + scenes.sizes_m / 2 - reach),
        F.relu(smallest - scenes.sizes_m),
        F.relu(scenes.sizes_m - largest),
    )
    return torch.stack(outside).mean()


def logit_penalty(scenes: DecodedScenes) -> Float[Tensor, ""]:
    """Mean square of the completeness logits, plus that of the class logits except `void`."""
    classes = scenes.class_logits[..., VOID + 1 :]
    return classes.square().mean() + scenes.completeness_logits.square().mean()


def diversity_loss(scenes: DecodedScenes) -> Float[Tensor, ""]:
    """Minus the mean log of the standard deviation of the k-th object's position and size over
    rooms, relative to `VARIED`.

    Up to a constant, this is minus the entropy of normal distributions with these deviations (after
    Kumar et al., "Maximum entropy generators for energy-based models", 2019). A deviation is at
    least about 1 mm, and it is not rewarded beyond `VARIED`, because that would drive objects out
    of the room.
    """
    boxes = torch.cat([scenes.centers_m[..., [0, 2]], scenes.sizes_m], dim=-1)
    wanted = boxes.new_tensor(VARIED).square()
    return -((boxes.var(dim=0, correction=0) + 1e-6) / wanted).clamp(max=1).log().mean() / 2
