"""Sections of a run's YAML that training reads: data, losses, stages, sampling, samples."""

from typing import Literal

from pydantic import Field

from sceneprior.settings import Section


class DataConfig(Section):
    """Which shards, and how much of each room a step sees."""

    shards: str
    """Folder of view shards (any `prep-*` command); relative to where the command runs."""
    views_per_room: int = Field(20, ge=1)
    """Views drawn per room and step (paper: 20), where a stage does not say otherwise."""
    view_fraction: float = Field(1.0, gt=0, le=1)
    """Share of each room's views that training may use (the paper's Table 4: 0.25, 0.5, 1)."""
    augment_rotations: bool = True
    """Add each room turned by 90, 180 and 270 degrees, each with a latent of its own."""
    mask_step: int = Field(4, ge=1)
    """Masks are compared at 1 / mask_step of the rendered resolution (paper: 4)."""
    workers: int = Field(0, ge=0)
    """Loader processes; 0 loads in the training process, which is fastest for small sets."""

    @property
    def rotations(self) -> int:
        """How many rows of a data set a room is."""
        return 4 if self.augment_rotations else 1


class LossConfig(Section):
    """Weights of the losses (lambda_l, lambda_box, ...) and settings of matching (section 4)."""

    class_: float = Field(1.0, ge=0, alias="class")
    box: float = Field(5.0, ge=0)
    completeness: float = Field(1.0, ge=0)
    frustum: float = Field(1.0, ge=0)
    mask: float = Field(2.0, ge=0)
    """lambda_S."""
    match_box: float = Field(5.0, ge=0)
    """lambda_B of the matching cost."""
    occlusion_slack: float = Field(1.0, ge=0, le=1)
    """Where another object touches a mask, the side of its 2D box there may be an occluder's. The
    part of a prediction that reaches further counts this much: 1 is the paper, which takes every
    side at its word; 0 lets objects go on behind others without end."""
    iou_gate: float = Field(0.5, ge=0, lt=1)
    """Masks whose IoU with their observation is not above this are left out of L_S."""
    latents: float = Field(0.0, ge=0)
    """For training rooms' logits that are spread as the N(0, 1) logits of new rooms are (sliced
    Wasserstein distance), so that more of the sphere is rooms; the paper: 0."""


class TrainConfig(Section):
    """How any stage of any method is trained. The optimiser is Adam."""

    epochs: int = Field(ge=1)
    batch_size: int = Field(16, ge=1)
    """Rooms a batch and process."""
    accumulate: int = Field(1, ge=1)
    """Batches whose gradients are averaged before each update."""
    clip_gradient: float = Field(0.0, ge=0)
    """Largest gradient norm; 0 does not clip."""
    cpu_threads: int | None = Field(None, ge=1)
    """Torch threads where a CPU trains; None leaves torch's choice. A small network gains little
    from a second thread and loses much when another program takes that core."""


class StageConfig(TrainConfig):
    """How a stage of the paper is trained. Released: AdamW without decay, which is Adam."""

    learning_rate: float = Field(1e-4, gt=0)
    latent_learning_rate: float = Field(1e-4, gt=0)
    """For the latent weights, which see one gradient an epoch, and for the bevels of `beveled_box`;
    the paper uses one rate for all."""
    schedule: Literal["steps", "cosine"] = "steps"
    """`steps`: times `decay` after each milestone (paper); `cosine`: a short rise, then a
    cosine down to zero, which reaches the same loss in fewer epochs."""
    milestones: tuple[int, ...] = Field((300,), strict=False)
    """Epochs after which the rates are multiplied by `decay`; `cosine` has no use for either."""
    decay: float = Field(0.1, gt=0, le=1)
    latent_noise: float = Field(0.0, ge=0)
    """Length of the random step each latent takes on the sphere before it is decoded, so that
    what lies between rooms is rooms, too. The paper takes none: 0."""
    latent_noise_end: float | None = Field(None, ge=0)
    """Where the noise ends, going there evenly over the stage; None keeps it as it is."""
    proxy: Literal["ellipsoid", "ellipsoid_points", "box", "beveled_box"] = "ellipsoid"
    """What an object's 2D box is taken from where its mesh is not (see `box_from`), in training
    from views and where rooms are fitted to images: the smooth ellipsoid that fills the 3D box,
    exactly; 162 of its points, which is slower and moves what is behind the camera in front of it,
    as the authors do with 2,562; the 3D box's corners; or `beveled_box`, the box with its edges cut
    off as far as its class has learnt to."""


class LayoutConfig(StageConfig):
    """How the layout stage is trained."""

    supervision: Literal["views", "lifted"] = "views"
    """`views`: 2D boxes of the views drawn in each step (paper); `lifted`: the 3D boxes that masks
    and cameras imply, found once before training (`lifting/boxes.py`)."""


class ShapeConfig(StageConfig):
    """How the shape stage of meshes is trained: the layout terms go on beside the mask term."""

    supervision: Literal["masks"] = "masks"
    decoder_learning_rate: float | None = Field(None, gt=0)
    """For the shape decoder, which starts fresh where the rest is trained; None: the same rate."""
    views_per_room: int | None = Field(None, ge=1)
    """Views drawn per room and step; None takes data.views_per_room."""
    sigma_px2: float | None = Field(None, gt=0)
    """Softness of silhouettes in squared pixels; None takes the paper's 1e-4 squared NDC."""
    silhouettes: Literal["exact", "fast"] = "exact"
    """`exact`: every face near a pixel counts (paper); `fast`: the outline alone."""
    compositing: Literal["layered", "paper"] = "paper"
    box_from: Literal["mesh", "proxy"] = "mesh"
    """Whether 2D boxes come from the deformed mesh (paper) or still from the proxy."""


class LiftedShapeConfig(StageConfig):
    """How the shape stage of occupancy grids is trained: lifted boxes teach the layout beside the
    shapes that were lifted with them (`loss.mask` weighs those)."""

    supervision: Literal["lifted"] = "lifted"
    decoder_learning_rate: float | None = Field(None, gt=0)
    """As in `ShapeConfig`."""


class SamplingConfig(Section):
    """Where new rooms come from."""

    distribution: Literal["sampler", "kernel", "geodesic", "gaussian", "paper"] = "kernel"
    """`sampler`: from a model of rooms' objects, without a latent (needs the section `sampler`).
    The others are distributions of latents: `kernel`: around training rooms; `geodesic`: between
    neighbouring ones; `gaussian`: fitted to their logits; `paper`: logits from N(0, 1)."""


class SamplesConfig(Section):
    """What a stage generates while it trains; the checkpoint that generates best is kept."""

    every: int = Field(0, ge=0)
    """Epochs from one evaluation to the next, and one at the stage's end; 0 never evaluates."""
    count: int = Field(200, ge=2)
    """Rooms generated each time, from the same seed and by the run's distribution of latents."""
    seed: int = Field(0, ge=0)
    metric: Literal["category_kl", "objects_off", "overlaps", "type_share", "mask_iou"] = (
        "category_kl"
    )
    """What `best.ckpt` is best in; the first three are better low, the others high."""
    against: Literal["val", "train"] = "val"
    """Rooms that `category_kl` and `objects_off` compare with; training rooms where there are no
    others. Never test rooms: a checkpoint chosen on them is no longer blind to them."""
