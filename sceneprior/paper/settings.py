"""Sections of a run's YAML that the paper's method adds: losses, its two stages, sampling."""

from typing import Annotated, Literal

from pydantic import Field

from sceneprior.core.settings import Section
from sceneprior.training.settings import TrainConfig


class LossConfig(Section):
    """Weights of the losses (lambda_l, lambda_box, ...) and settings of matching (section 4)."""

    class_: float = Field(1.0, ge=0, alias="class")
    """lambda_l of Eq. 7."""
    box: float = Field(5.0, ge=0)
    """lambda_box of Eq. 7."""
    completeness: float = Field(1.0, ge=0)
    """lambda_p of Eq. 7."""
    frustum: float = Field(1.0, ge=0)
    """lambda_f of Eq. 7."""
    mask: float = Field(2.0, ge=0)
    """lambda_S, the weight of the shape loss (Eq. 8)."""
    match_box: float = Field(5.0, ge=0)
    """lambda_B of the matching cost (Eq. S2)."""
    occlusion_slack: float = Field(1.0, ge=0, le=1)
    """Weight of the part of a predicted 2D box that extends beyond a side of the observed box where
    another object touches the mask and may hide the rest. 1 is the paper, which trusts every side;
    at 0, objects may extend behind others without limit."""
    iou_gate: float = Field(0.5, ge=0, lt=1)
    """Masks whose IoU with the observed mask is not above this are left out of L_S (Eq. 8)."""


class LatentStageConfig(TrainConfig):
    """Learning rates of a stage that trains the network together with one latent per training
    room."""

    learning_rate: float = Field(1e-4, gt=0)
    """Learning rate of the network."""
    latent_learning_rate: float = Field(1e-4, gt=0)
    """Learning rate of the latent logits, which get one gradient per epoch, and of the bevels of
    `beveled_box`; the paper uses one rate for all."""
    latent_noise: float = Field(0.0, ge=0)
    """Length of a random step that each latent takes on the sphere before it is decoded, so that
    points between rooms decode into rooms, too. 0 (the paper) takes none."""
    latent_noise_end: float | None = Field(None, ge=0)
    """Length of that step at the end of the stage, reached linearly; None keeps it constant."""

    @property
    def shape_rate(self) -> float:
        """Learning rate of the shape decoder."""
        return self.learning_rate


class Steps(Section):
    """Learning rates are multiplied by `decay` after each milestone (paper)."""

    name: Literal["steps"] = "steps"
    milestones: tuple[int, ...] = Field((300,), strict=False)
    """Epochs after which the rates fall."""
    decay: float = Field(0.1, gt=0, le=1)


class Cosine(Section):
    """Learning rates rise for a twentieth of the stage, then fall to 0 along a cosine; this reaches
    the same loss in fewer epochs."""

    name: Literal["cosine"] = "cosine"


class StageConfig(LatentStageConfig):
    """Training of a stage of the paper. The released code uses AdamW without decay, which is
    Adam."""

    schedule: Annotated[Steps | Cosine, Field(discriminator="name")] = Steps()
    proxy: Literal["ellipsoid", "beveled_box"] = "ellipsoid"
    """Shape that an object's 2D box is computed from where its mesh is not used (see `box_from`),
    in training from views and when rooms are fitted to images. `ellipsoid`: the smooth ellipsoid
    that fills the 3D box, in closed form. `beveled_box`: the box with its edges cut off by the
    learnt bevels of its class."""


class LayoutConfig(StageConfig):
    """Training of the layout stage, on the 2D boxes of the views drawn in each step."""


class ShapeConfig(StageConfig):
    """Training of the shape stage of meshes: the layout losses continue beside the mask loss."""

    decoder_learning_rate: float | None = Field(None, gt=0)
    """Learning rate of the shape decoder, which starts fresh while the rest is trained; None takes
    `learning_rate`."""
    views_per_room: int | None = Field(None, ge=1)
    """Views drawn per room and step; None takes data.views_per_room."""
    sigma_px2: float | None = Field(None, gt=0)
    """Softness of silhouettes in squared pixels; None takes the paper's 1e-4 squared NDC."""
    silhouettes: Literal["exact", "fast"] = "exact"
    """`exact`: every face near a pixel counts (paper); `fast`: the outline alone."""
    compositing: Literal["layered", "paper"] = "paper"
    """Visible masks of overlapping objects. `paper`: the scene's coverage goes to the front-most
    object of each pixel; `layered`: a boundary between two objects also moves the one in front."""
    box_from: Literal["mesh", "proxy"] = "mesh"
    """`mesh`: 2D boxes come from the deformed mesh (paper); `proxy`: still from the proxy."""

    @property
    def shape_rate(self) -> float:
        return self.decoder_learning_rate or self.learning_rate


class SamplingConfig(Section):
    """Sampling of new rooms."""

    distribution: Literal["kernel", "paper"] = "paper"
    """Distribution of latents. `paper`: logits from N(0, 1); `kernel`: near training rooms, most
    of its rooms being near copies of one."""
