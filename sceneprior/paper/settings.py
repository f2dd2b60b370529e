"""Sections of a run's YAML that the paper's method adds: losses, its two stages, sampling."""

from typing import Annotated, Literal

from pydantic import Field

from sceneprior.core.settings import Section
from sceneprior.training.method import TrainConfig


class LossConfig(Section):
    """Weights of the losses (lambda_l, lambda_box, ...) and settings of matching (section 4)."""

    class_: float = Field(1.0, ge=0, alias="class")
    """lambda_l of Eq. 7, the weight of classes. Only ratios of the weights change the result."""
    box: float = Field(5.0, ge=0)
    """lambda_box of Eq. 7, the weight of 2D boxes."""
    completeness: float = Field(1.0, ge=0)
    """lambda_p of Eq. 7, the weight of the number of objects."""
    frustum: float = Field(1.0, ge=0)
    """lambda_f of Eq. 7, the weight that moves matched objects into the view."""
    mask: float = Field(2.0, ge=0)
    """lambda_S, the weight of the shape loss (Eq. 8)."""
    match_box: float = Field(5.0, ge=0)
    """lambda_B of the matching cost (Eq. S2): larger values match by position more than by
    class."""
    occlusion_slack: float = Field(1.0, ge=0, le=1)
    """Weight of the distance by which a predicted 2D box extends beyond the observed box at a side
    where another object touches the mask and may occlude the rest. 1 (the paper) trusts every side;
    at 0, objects may extend behind others without limit."""
    iou_gate: float = Field(0.5, ge=0, lt=1)
    """Masks enter L_S (Eq. 8) only if their IoU with the observed mask is above this value. At 0,
    all masks that overlap enter it, even those of wrong matches."""
    passing_masks_only: bool = False
    """Average L_S over the pairs of masks that pass the gate, as in the released code. If false,
    the others count as 0 (Eq. 8). It has no effect when rooms are fitted to images."""


class LatentStageConfig(TrainConfig):
    """Settings of a stage that trains the network together with one latent per training room."""

    learning_rate: float = Field(1e-4, gt=0)
    """Learning rate of the network. If it is too large, the loss jumps or is not finite; if too
    small, the stage needs more epochs."""
    latent_learning_rate: float = Field(1e-4, gt=0)
    """Learning rate of the latent logits, which get one gradient per epoch, and of the bevels of
    `beveled_box`; the paper uses one rate for everything."""
    latent_noise: float = Field(0.0, ge=0)
    """Length of a random step on the sphere that is added to each latent before decoding, so that
    points between the latents of rooms decode into rooms, too. 0 (the paper) adds none."""
    latent_noise_end: float | None = Field(None, ge=0)
    """Length of that step at the end of the stage, reached linearly; None keeps it constant."""

    @property
    def shape_rate(self) -> float:
        """Learning rate of the shape decoder, which a stage may set apart."""
        return getattr(self, "decoder_learning_rate", None) or self.learning_rate


class Steps(Section):
    """Learning rates are multiplied by `decay` after each milestone (paper)."""

    name: Literal["steps"] = "steps"
    milestones: tuple[int, ...] = Field((300,), strict=False)
    """Epochs after which the rates fall."""
    decay: float = Field(0.1, gt=0, le=1)
    """Factor of the rates at each milestone; 1 keeps them constant."""


class Cosine(Section):
    """Learning rates rise during the first twentieth of the stage, then fall to 0 along a cosine.
    The same loss is reached in fewer epochs than with `steps`."""

    name: Literal["cosine"] = "cosine"


class StageConfig(LatentStageConfig):
    """Training of a stage of the paper. The released code uses AdamW without decay, which is
    Adam."""

    schedule: Annotated[Steps | Cosine, Field(discriminator="name")] = Steps()
    latent_epochs: int = Field(0, ge=0)
    """Epochs at the end, part of `epochs`, that train the latents alone; released code: 50 more."""
    proxy: Literal["ellipsoid", "beveled_box"] = "ellipsoid"
    """Shape from which an object's 2D box is computed where its mesh is not used (see `box_from`),
    in training from views and when rooms are fitted to images. `ellipsoid`: the ellipsoid inscribed
    in the 3D box, in closed form. `beveled_box`: the 3D box with its edges cut off by the learnt
    bevels of the class."""
    cuda_graphs: bool = True
    """On a single GPU, run the parts of a step whose shapes never change as CUDA graphs
    (`StaticStep`), unless `accumulate` is above 1. A loss that is not finite is then noticed one
    step later, and the last bits of sums differ. It has no effect on a CPU."""


class LayoutConfig(StageConfig):
    """Training of the layout stage, on the 2D boxes of the views sampled in each step."""


class ShapeConfig(StageConfig):
    """Training of the shape stage for meshes, with the layout losses and the mask loss."""

    decoder_learning_rate: float | None = Field(None, gt=0)
    """Learning rate of the shape decoder, which is untrained when this stage begins, unlike the
    rest of the network; None uses `learning_rate`."""
    views_per_room: int | None = Field(None, ge=1)
    """Views sampled per room and step, each of which is rendered; None uses
    `data.views_per_room`."""
    sigma_px2: float | None = Field(None, gt=0)
    """Softness of silhouettes in squared pixels; None uses the paper's 1e-4 squared NDC. Smaller is
    crisper, and pulls on fewer pixels."""
    silhouettes: Literal["exact", "fast"] = "exact"
    """`exact`: every face near a pixel counts (paper: at most 50); `fast`: the outline alone."""
    compositing: Literal["layered", "paper"] = "paper"
    """Visible masks of overlapping objects. `paper`: the scene's coverage goes to the front-most
    object of each pixel; `layered`: a boundary between two objects also moves the one in front."""
    box_from: Literal["mesh", "proxy"] = "mesh"
    """Shape from which 2D boxes are computed in this stage: the deformed `mesh` (paper), or the
    `proxy`, as in the layout stage."""


class SamplingConfig(Section):
    """Sampling of new rooms."""

    distribution: Literal["kernel", "paper"] = "paper"
    """Distribution of latents. `paper`: logits from N(0, 1). `kernel`: logits near those of
    training rooms; most of the resulting rooms are near copies of one."""
