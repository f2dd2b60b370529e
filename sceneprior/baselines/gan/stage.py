"""The GAN baseline: our network against a discriminator of semantic maps, without a view loss."""

import copy
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import ClassVar, Literal

import lightning
import torch
from jaxtyping import Float
from lightning.pytorch.core.optimizer import LightningOptimizer
from pydantic import Field
from torch import Tensor, nn
from torch.optim.swa_utils import get_ema_multi_avg_fn

from sceneprior.baselines.gan.discriminator import MapDiscriminator
from sceneprior.baselines.gan.losses import (
    adversarial_loss,
    bounds_penalty,
    contents,
    diversity_loss,
    logit_penalty,
)
from sceneprior.baselines.gan.semantic_maps import (
    choices,
    observed_counts,
    observed_maps,
    rendered_maps,
)
from sceneprior.data.dataset import ViewDataset
from sceneprior.models.layout_decoder import LayoutDecoder
from sceneprior.models.prior import ModelConfig
from sceneprior.models.shape_decoder import ShapeDecoderConfig
from sceneprior.models.transformer import TransformerConfig
from sceneprior.training.method import PriorConfig, Stage
from sceneprior.training.objective import check_finite, full_precision
from sceneprior.training.settings import TrainConfig
from sceneprior.views import DecodedScenes, SceneViews

BETAS = (0.0, 0.99)
"""Of both Adams: momentum would push on after the opponent has moved."""

STARTS = ((0.0, 1.2), (0.4, 0.4), (0.0, 1.2), (0.4, 0.5), (0.4, 0.5), (0.4, 0.5), (1.5, 1.0))
"""Mean and spread, over rooms and objects, of what the layout decoder starts from: x, y, z, then
width, height, depth before their SoftPlus, then completeness. Metres where they are metres."""

START_ROOMS = 64

SHAPE_RATE = 0.1
"""Of the generator's learning rate, for the shape decoder: maps are content with sheared boxes."""

LOGIT_PENALTY = 0.01
"""Weight of the mean square of class and completeness logits. A choice that is all but certain has
no gradient: a generator whose objects had all gone would never come back."""

BOUNDS_PENALTY = 10.0
"""Weight of what leaves where rooms are and how large furniture is."""

MEMORY = 0.9
"""Share of `excess` that is kept at each step: a batch alone says little of rare classes."""


class GanTraining(TrainConfig):
    """How the two opponents are trained; docs/baselines_2d.md says what each setting is for.

    Maps are half as large as the instance ids that `data.mask_step` keeps.
    """

    epochs: int = Field(400, ge=1)
    batch_size: int = Field(16, ge=1)
    """Real rooms a step, and as many generated ones."""
    accumulate: Literal[1] = 1
    """The two opponents take turns at every batch."""
    views_per_room: int = Field(4, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    """Of the generator's Adam; its shape decoder has a tenth."""
    discriminator_learning_rate: float = Field(4e-3, gt=0)
    """Of the discriminator's. Too large: it is soon always right, and teaches nothing; too small:
    the generator runs ahead to whatever it finds unusual."""
    counts: float = Field(1.0, ge=0)
    """Weight of the generator's second aim: as much of each class a room, on average, as real rooms
    have, in objects and in pixels. 0 leaves that to the discriminator, and classes drift."""
    variety: float = Field(4.0, ge=0)
    """Weight of the generator's third aim: that the k-th object of different rooms has different
    places and sizes. Too small: all rooms end up as one; too large: objects are anywhere."""
    averaging: float = Field(0.97, ge=0, lt=1)
    """Share of the averaged generator that is kept at each step; 0 keeps the newest alone."""
    noise: float = Field(0.1, ge=0)
    """Spread of the noise on all maps at the start; it falls to 0 over the epochs. Without it,
    classes can be lost for good."""
    clip_gradient: float = Field(1.0, ge=0)
    """Largest gradient norm of each of the two; 0 does not clip."""
    silhouettes: Literal["exact", "fast"] = "fast"
    """As in the shape stage of `ours`."""


class GanModel(ModelConfig):
    """The paper's network. Its maps are drawn from meshes, so no shape is an occupancy grid."""

    decoder: TransformerConfig = TransformerConfig()
    shape: ShapeDecoderConfig = ShapeDecoderConfig()


class GanConfig(PriorConfig):
    """A run of the GAN. Its objects are never void (docs/baselines_2d.md)."""

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
    """Generator and discriminator in turn, once each a batch (supplement, Baselines).

    A room is generated for each of the batch, from logits drawn from N(0, 1), and drawn as semantic
    maps into that room's own cameras. There are no latents of rooms: nothing pairs a generated
    room with a real one. What keeps it stable is listed in docs/baselines_2d.md.

    `generator` is what plays; `prior`, which tasks take out of checkpoints, is a running average of
    its weights, in which the two opponents' circling cancels. `excess` is how much more
    of each class a generated room has than a real one, of late: objects, and pixels (`contents`).
    """

    def __init__(self, config: GanConfig):
        super().__init__()
        self.automatic_optimization = False
        self.model, self.settings = config.model, config.training
        self.classes = config.classes
        self.generator = prior = config.build_prior()
        spread_out(prior.layout, prior.decoder(self._latents(START_ROOMS), prior.max_objects))
        self.prior = copy.deepcopy(prior).requires_grad_(False)
        self.average = get_ema_multi_avg_fn(config.training.averaging)
        # A GAN pairs no point of the latent space with a room; checkpoints of all priors are alike.
        self.latents = config.build_latents(0)
        self.discriminator = MapDiscriminator(self.classes)
        self.excess: Tensor
        self.register_buffer("excess", torch.zeros(2 * self.classes))

    def training_step(self, views: SceneViews, batch_idx: int) -> None:
        generator_optimizer, discriminator_optimizer = self.optimizers()  # type: ignore[attr-defined]
        scenes = self.generator.decode(self._latents(len(views.room_index)))
        with full_precision(self.device):
            # Before rendering, too, which refuses vertices that are not finite.
            undecided = logit_penalty(scenes)
            check_finite(undecided + scenes.centers_m.sum() + scenes.sizes_m.sum(), views)
            real = observed_maps(views, self.classes)
            fake, counts = self._draw(scenes, views)
            more = contents(fake, counts) - contents(real, observed_counts(views, self.classes))
            self.excess.lerp_(more.detach().mean(dim=0), 1 - MEMORY)
            loss = LOGIT_PENALTY * undecided + BOUNDS_PENALTY * bounds_penalty(scenes, views)
            loss = loss + self.settings.variety * diversity_loss(scenes)
            loss = loss + self.settings.counts * (more @ self.excess).mean()

        # Real maps come in steps that rendered ones lack.
        noise = self.settings.noise * self._left()
        real, fake = (maps + noise * torch.randn_like(maps) for maps in (real, fake))
        real_scores = self.discriminator(real)
        fake_scores = self.discriminator(fake.detach())
        told_apart = adversarial_loss(real_scores, real=True) + adversarial_loss(
            fake_scores, real=False
        )
        self._update(discriminator_optimizer, told_apart)

        self.discriminator.requires_grad_(False)
        loss = loss + adversarial_loss(self.discriminator(fake), real=True)
        check_finite(loss, views)
        self._update(generator_optimizer, loss)
        self.discriminator.requires_grad_(True)
        self.average(list(self.prior.parameters()), list(self.generator.parameters()), 0)
        said = {
            "loss": loss,
            "discriminator": told_apart,
            "real_score": torch.stack([score.mean() for score in real_scores]).mean(),
            "fake_score": torch.stack([score.mean() for score in fake_scores]).mean(),
            "objects": counts.sum(dim=1).mean(),
        }
        said = {f"train/{name}": value.detach() for name, value in said.items()}
        self.log_dict(said, on_step=False, on_epoch=True, batch_size=len(counts))

    def on_train_epoch_start(self) -> None:
        """Rates fall evenly to 0, so that the opponents' circling ends, too."""
        for optimizer in self.optimizers():  # type: ignore[union-attr]
            for group in optimizer.param_groups:
                group["lr"] = group["initial_lr"] * self._left()

    def _left(self) -> float:
        """Share of the training that is still to come."""
        return 1 - self.current_epoch / self.settings.epochs

    def _latents(self, rooms: int) -> Float[Tensor, "rooms width"]:
        shape = (rooms, self.model.logits_per_room)
        with full_precision(self.device):
            return self.generator.latent_space(torch.randn(shape, device=self.device))

    def _draw(self, scenes: DecodedScenes, views: SceneViews) -> tuple[Tensor, Tensor]:
        """Maps, and how many objects of each class are in each room."""
        kept, classes = choices(scenes, self.model.completeness_target)
        faces, mode = self.generator.faces, self.settings.silhouettes
        assert faces is not None, "GanModel has meshes"
        maps = rendered_maps(scenes, faces, views, kept, classes, mode)
        return maps, (kept.unsqueeze(-1) * classes).sum(dim=1)

    def _update(self, optimizer: LightningOptimizer, loss: Tensor) -> None:
        optimizer.zero_grad()
        self.manual_backward(loss)
        self.clip_gradients(optimizer, self.settings.clip_gradient, "norm")  # type: ignore[arg-type]
        optimizer.step()

    def configure_optimizers(self) -> list[torch.optim.Optimizer]:
        rates = self.settings
        shape = list(self.generator.shape.parameters())
        others = [p for name, p in self.generator.named_parameters() if "shape." not in name]
        return [
            _adam((others, rates.learning_rate), (shape, SHAPE_RATE * rates.learning_rate)),
            _adam((self.discriminator.parameters(), rates.discriminator_learning_rate)),
        ]


def _adam(*parts: tuple[Iterable[nn.Parameter], float]) -> torch.optim.Optimizer:
    groups = [{"params": own, "lr": rate, "initial_lr": rate} for own, rate in parts]
    return torch.optim.Adam(groups, betas=BETAS)


@torch.no_grad()
def spread_out(layout: LayoutDecoder, features: Float[Tensor, "rooms objects width"]) -> None:
    """Start with objects all over the floor, of all sizes and classes.

    A fresh layout decoder puts every object at the floor centre, all of one class, and the
    discriminator would pull all of them the same way: they would never part. So its last layer is
    scaled and shifted until each output has the mean and the spread over these rooms and objects
    that `STARTS` names, and class logits 0 and 1 (after Salimans and Kingma, "Weight
    normalization", NeurIPS 2016, section 3). `features` are those of random rooms.
    """
    outputs = layout.mlp2(layout.mlp1(features)).flatten(0, 1)
    starts = [(0.0, 1.0)] * layout.classes + list(STARTS)
    rows = zip(layout.mlp2.rows(), outputs.unbind(dim=1), starts, strict=True)
    for (weight, bias), values, (mean, spread) in rows:
        scale = spread / values.std()
        weight *= scale
        bias.copy_(mean + scale * (bias - values.mean()))
