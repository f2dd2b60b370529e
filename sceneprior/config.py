"""What a run is: one frozen, checked `RunConfig`, read from a YAML and written beside the run."""

from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, model_validator

from sceneprior.classes import label_set
from sceneprior.errors import InputError
from sceneprior.settings import Section, check_settings, read_settings


class DataConfig(Section):
    """Which shards, and how much of each room a step sees."""

    shards: str
    """Folder that `sceneprior prep-front` wrote; relative to where the command runs."""
    views_per_room: int = Field(20, ge=1)
    """Views drawn per room and step in the layout stage (paper: 20)."""
    view_fraction: float = Field(1.0, gt=0, le=1)
    """Share of each room's views that training may use (the paper's Table 4: 0.25, 0.5, 1)."""
    augment_rotations: bool = True
    """Add each room turned by 90, 180 and 270 degrees, each with a latent of its own."""
    mask_step: int = Field(4, ge=1)
    """Masks are compared at 1 / mask_step of the rendered resolution (paper: 4)."""
    workers: int = Field(0, ge=0)
    """Loader processes; 0 loads in the training process, which is fastest for small sets."""


class ModelConfig(Section):
    """The network (section 3 and supplement A)."""

    max_objects: int = Field(ge=1)
    """N: 13 for bedrooms, 28 for living rooms, 53 for ScanNet."""
    width: int = Field(512, ge=8)
    """D_z, of latents and object features."""
    anchors: int = Field(100, ge=2)
    """M fixed unit vectors that latents are mixed from; 100 in the authors' code."""
    heads: int = Field(4, ge=1)
    hidden: int = Field(1024, ge=8)
    """Inner width of the feed-forward layers."""
    dropout: float = Field(0.1, ge=0, lt=1)
    latent: Literal["sphere", "uniform"] = "sphere"
    """Where latents live: `sphere` (paper), or `uniform`, a cube with one logit a coordinate, in
    which `sampling.distribution: paper` draws uniformly (ablation c1; `anchors` has no say)."""
    decoder: Literal["transformer", "lstm", "atiss"] = "transformer"
    """What emits object features: the `transformer` (paper); an `lstm` that takes z first and
    then its own last output (ablation c2; `heads`, `hidden` and `dropout` have no say); or the
    encoder of `atiss`, in which z takes the empty embedding's place (ATISS-2D; as published it
    has `heads` 8, `hidden` 1024)."""
    encoder_layers: int = Field(4, ge=1)
    """Of the encoder of `atiss` alone; 4 are published."""
    norm_first: bool = False
    """In the encoder of `atiss` alone: normalise before attention and feed-forward, not after
    their residuals as published. Learns at higher rates (docs/baselines_2d.md)."""
    final_norm: bool = False
    """Normalise once more after the encoder layer and after the decoder layer, as the released
    code and the default of the library that it builds on."""
    query_self_attention: bool = False
    """Give the decoder layer self attention over its one query, z, as the released code."""
    step_mlps: bool = False
    """End step k in a two-layer MLP of its own, as the released code: 0.5 million weights a step
    at width 512, and the k-th object knows that it is the k-th."""
    layout_heads: Literal["joint", "separate"] = "joint"
    """MLP2 is one MLP for all (`joint`), or a linear layer for the classes and an MLP of its own
    for each of x, y, z, width, height and depth (`separate`, released code)."""
    shape_width: int = Field(256, ge=8)
    shape_level: int = Field(4, ge=0, le=6)
    """Icosphere subdivisions of the template: 20 * 4**level faces."""
    template: Literal["sphere", "box"] = "sphere"
    """What shapes are deformed from; `box` starts from the box that the layout stage fitted."""
    fit_box: bool = False
    """Keep each mesh filling its box exactly, so that boxes stay the meshes' own."""

    @model_validator(mode="after")
    def _heads_divide_width(self) -> "ModelConfig":
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {self.heads}")
        return self

    @model_validator(mode="after")
    def _parts_belong_to_the_decoder(self) -> "ModelConfig":
        for part in ("final_norm", "query_self_attention", "step_mlps"):
            if self.decoder != "transformer" and getattr(self, part):
                raise ValueError(
                    f"{part} is a part of the transformer, but decoder is '{self.decoder}'; "
                    "set it to false"
                )
        if self.norm_first and self.decoder != "atiss":
            raise ValueError(
                f"norm_first is a part of atiss, but decoder is '{self.decoder}'; set it to false"
            )
        return self

    @property
    def logits_per_room(self) -> int:
        """How many numbers a room's latent is learnt as."""
        return self.width if self.latent == "uniform" else self.anchors


class LossConfig(Section):
    """Weights of the terms (section 4)."""

    class_: float = Field(1.0, ge=0, alias="class")
    box: float = Field(5.0, ge=0)
    completeness: float = Field(1.0, ge=0)
    completeness_target: Literal["first_n", "stop"] = "first_n"
    """Of n objects, `first_n` wants ones for the first n predictions and zeros after (supplement
    B); `stop` wants ones from the last object on and ends a generated scene with the first object
    that has one (main text, released code). Decoding follows the same convention."""
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
    """Masks that overlap less than this teach no shape."""


class StageConfig(Section):
    """How one stage is trained. The optimiser is Adam; released, AdamW without decay: the same."""

    epochs: int = Field(ge=1)
    batch_size: int = Field(16, ge=1)
    """Rooms a batch and process."""
    accumulate: int = Field(1, ge=1)
    """Batches whose gradients are averaged before each update."""
    learning_rate: float = Field(1e-4, gt=0)
    latent_learning_rate: float = Field(1e-4, gt=0)
    """For the latent weights, which see one gradient an epoch; the paper uses one rate for all."""
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
    clip_gradient: float = Field(0.0, ge=0)
    """Largest gradient norm; 0 does not clip."""
    cpu_threads: int | None = Field(None, ge=1)
    """Torch threads where a CPU trains; None leaves torch's choice. A small network gains little
    from a second thread and loses much when another program takes that core."""
    proxy: Literal["ellipsoid", "ellipsoid_points", "box", "beveled_box"] = "ellipsoid"
    """What an object's 2D box is taken from where its mesh is not (see `box_from`): the smooth
    ellipsoid that fills the 3D box, exactly; 162 of its points, which is slower and moves what is
    behind the camera in front of it, as the authors do with 2,562; the 3D box's corners; or
    `beveled_box`, the box with its edges cut off as far as its class has learnt to."""


class ShapeConfig(StageConfig):
    """How the shape stage is trained: the layout terms go on beside the mask term."""

    decoder_learning_rate: float | None = Field(None, gt=0)
    """For the shape decoder, which starts fresh where the rest is trained; None: the same rate."""
    views_per_room: int | None = Field(None, ge=1)
    """Views drawn per room and step; None takes data.views_per_room."""
    sigma_px2: float | None = Field(None, gt=0)
    """Softness of silhouettes in squared pixels; None takes the paper's 1e-4 squared NDC."""
    silhouettes: Literal["exact", "fast"] = "exact"
    """`exact`: every face near a pixel has its say (paper); `fast`: the outline alone."""
    compositing: Literal["layered", "paper"] = "paper"
    box_from: Literal["mesh", "proxy"] = "mesh"
    """Whether 2D boxes come from the deformed mesh (paper) or still from the proxy."""


class GanConfig(Section):
    """The GAN (`stages: gan`); docs/baselines_2d.md says what each is for. Maps are half as large
    as the instance ids that `data.mask_step` keeps; renders take `shape.silhouettes`."""

    epochs: int = Field(400, ge=1)
    batch_size: int = Field(16, ge=1)
    """Real rooms a step, and as many generated ones."""
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
    cpu_threads: int | None = Field(None, ge=1)
    """As in `layout`."""


class BoxStageConfig(Section):
    """What the baselines that learn from boxes in 3D have in common. The optimiser is Adam."""

    epochs: int = Field(ge=1)
    batch_size: int = Field(ge=1)
    """Rooms a batch and process."""
    accumulate: int = Field(1, ge=1)
    """Batches whose gradients are averaged before each update."""
    learning_rate: float = Field(gt=0)
    schedule: Literal["constant", "cosine"] = "constant"
    """`constant` (published, both), or a short rise and a `cosine` down to zero."""
    clip_gradient: float = Field(0.0, ge=0)
    """Largest gradient norm; 0 does not clip. Do not clip `atiss3d` (docs/baselines_3d.md)."""
    cpu_threads: int | None = Field(None, ge=1)
    """As in `layout`."""
    width: int = Field(512, ge=8)
    """Of the hidden layers."""


class Atiss3dConfig(BoxStageConfig):
    """ATISS with 3D supervision (`stages: atiss3d`); the defaults are the published settings."""

    epochs: int = Field(500, ge=1)
    """With turned copies of 6,300 rooms these are the published 100,000 steps."""
    batch_size: int = Field(128, ge=1)
    learning_rate: float = Field(1e-4, gt=0)
    layers: int = Field(4, ge=1)
    """Of the transformer encoder."""
    heads: int = Field(8, ge=1)
    hidden: int = Field(1024, ge=8)
    """Inner width of its feed-forward layers."""
    mixtures: int = Field(10, ge=1)
    """K, logistics a coordinate."""
    dropout: float = Field(0.1, ge=0, lt=1)

    @model_validator(mode="after")
    def _heads_divide_width(self) -> "Atiss3dConfig":
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {self.heads}")
        return self


class Sync2genConfig(BoxStageConfig):
    """The Sync2Gen-style VAE (`stages: sync2gen`); epochs, batch, rate and latent as released."""

    epochs: int = Field(800, ge=1)
    batch_size: int = Field(64, ge=1)
    learning_rate: float = Field(1e-3, gt=0)
    latent: int = Field(20, ge=1)
    """Numbers a room is boiled down to."""
    slots: int = Field(8, ge=1)
    """Objects of one class that a room can hold (released: 4); further ones are left out, and
    their share is logged as `train/left_out`."""
    kl_weight: float = Field(0.1, ge=0)
    """Of the KL divergence from N(0, 1). Larger: new rooms are more like each other and better
    formed; smaller: training rooms are remembered better, and what lies between is worse."""
    refine_steps: int = Field(100, ge=0)
    """Gradient steps on each new room's positions, towards offsets between classes as training
    rooms have them; 0 takes rooms as decoded (the paper's Sync2Gen*). Acts on sampling alone."""

    @model_validator(mode="after")
    def _width_in_groups(self) -> "Sync2genConfig":
        if self.width % 8:
            raise ValueError(f"width {self.width} is not a multiple of 8")
        return self


class SamplingConfig(Section):
    """Where new latents come from."""

    distribution: Literal["kernel", "geodesic", "gaussian", "paper"] = "kernel"
    """`kernel`: around training rooms; `geodesic`: between neighbouring ones; `gaussian`: fitted
    to their logits; `paper`: logits from N(0, 1)."""


class SamplesConfig(Section):
    """What a stage generates while it trains; the checkpoint that generates best is kept."""

    every: int = Field(0, ge=0)
    """Epochs from one look to the next, and one at the stage's end; 0 never looks."""
    count: int = Field(200, ge=2)
    """Rooms generated at each look, always from the same seed and by the run's sampling distribution."""
    seed: int = Field(0, ge=0)
    metric: Literal["category_kl", "objects_off", "overlaps", "type_share", "mask_iou"] = (
        "category_kl"
    )
    """What `best.ckpt` is best in; the first three are better low, the others high."""
    against: Literal["test", "train"] = "test"
    """Rooms that `category_kl` and `objects_off` compare with; training rooms where there are no
    others. A checkpoint chosen by its test score is no longer blind to the test rooms: take
    `train` where `best.ckpt` is to be reported."""


class RunConfig(Section):
    """Everything a run is; saved with it as `config.yaml`."""

    label_set: str
    """A name in `sceneprior/classes.py`, or a list of one's own: `void,bed,chair`."""
    seed: int = Field(0, ge=0)
    stages: Literal["two", "one", "gan", "atiss3d", "sync2gen"] = "two"
    """`two`: layout, then layout and shape together (paper); `one`: the second from scratch, so
    that boxes and shapes are learnt together (ablation c3; the section `layout` has no say).
    Baselines, by the section of their name: `gan` learns from a discriminator instead of the view
    loss; `atiss3d` and `sync2gen` learn from true boxes in 3D, and of the other sections only
    `data`, `samples` and `model.max_objects` concern them."""
    data: DataConfig
    model: ModelConfig
    loss: LossConfig = LossConfig()
    layout: StageConfig
    shape: ShapeConfig
    gan: GanConfig = GanConfig()
    atiss3d: Atiss3dConfig = Atiss3dConfig()
    sync2gen: Sync2genConfig = Sync2genConfig()
    sampling: SamplingConfig = SamplingConfig()
    samples: SamplesConfig = SamplesConfig()

    @model_validator(mode="after")
    def _known_label_set(self) -> "RunConfig":
        try:
            label_set(self.label_set)
        except InputError as error:
            raise ValueError(f"label_set: {str(error).removesuffix('.')}") from None
        return self


def load_config(name: str, overrides: tuple[str, ...] = ()) -> RunConfig:
    """Read a config and apply `section.key=value` overrides.

    Raises:
        ConfigError: not found, not YAML, an unknown key or a wrong value; the message names the
            file, the key and, for a typo, the nearest key.
    """
    path, data = read_settings(name, overrides)
    return check_config(data, str(path))


def check_config(data: dict[str, Any], source: str) -> RunConfig:
    """Turn plain data into a `RunConfig`, or say in one sentence what is wrong with it."""
    return check_settings(RunConfig, data, source)


def dump_config(config: RunConfig, path: Path) -> None:
    """Write the resolved settings, every default included."""
    data = config.model_dump(mode="json", by_alias=True)
    path.write_text(yaml.safe_dump(data, sort_keys=False))
