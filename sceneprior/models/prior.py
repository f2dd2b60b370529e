"""The whole prior, f of Eq. 1: from logits or latents to decoded scenes."""

from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from pydantic import Field, field_validator, model_validator
from torch import Tensor, nn
from torch.nn import functional as F

from sceneprior.geometry.meshes import place
from sceneprior.models.latents import CubeConfig, LatentSpace, SphereConfig
from sceneprior.models.layers import DecoderConfig
from sceneprior.models.layout_decoder import ClassBevels, LayoutDecoder
from sceneprior.models.occupancy import OccupancyConfig, OccupancyDecoder
from sceneprior.models.shape_decoder import ShapeDecoderConfig
from sceneprior.settings import Section
from sceneprior.views import DecodedScenes


class ModelConfig(Section):
    """The network (section 3 and supplement A). `config.py` lists the choices of `decoder`."""

    max_objects: int = Field(ge=1, le=1000)
    """N: 13 for bedrooms, 28 for living rooms, 53 for ScanNet."""
    width: int = Field(512, ge=8)
    """D_z, of latents and object features."""
    latent_space: Annotated[SphereConfig | CubeConfig, Field(discriminator="name")] = SphereConfig()
    decoder: DecoderConfig
    layout_heads: Literal["joint", "separate"] = "joint"
    """MLP2 is one MLP for all (`joint`), or a linear layer for the classes and an MLP of its own
    for each of x, y, z, width, height and depth (`separate`, released code)."""
    floor_gradient: bool = False
    """Whether an object that ReLU holds at the floor (Eq. S1) can learn to leave it. With the
    paper's ReLU, false, it cannot: lamps may stay on the floor for good."""
    completeness_target: Literal["first_n", "stop"] = "first_n"
    """Of n objects, `first_n` wants ones for the first n predictions and zeros after (supplement
    B); `stop` wants ones from the last object on and ends a generated scene with the first object
    that has one (main text, released code). Decoding follows the same convention."""
    shape: Annotated[ShapeDecoderConfig | OccupancyConfig, Field(discriminator="name")] = (
        ShapeDecoderConfig()
    )
    """What a shape is: a deformed `mesh` (paper; also without a name), or an `occupancy` grid."""

    @field_validator("shape", mode="before")
    @classmethod
    def _mesh_by_default(cls, shape: Any) -> Any:
        return {"name": "mesh"} | shape if isinstance(shape, dict) else shape

    @model_validator(mode="after")
    def _heads_divide_width(self) -> "ModelConfig":
        heads = getattr(self.decoder, "heads", 1)
        if self.width % heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {heads}")
        return self

    @property
    def logits_per_room(self) -> int:
        """How many numbers a room's latent is learnt as."""
        space = self.latent_space
        return space.anchors if isinstance(space, SphereConfig) else self.width


class ScenePrior(nn.Module):
    """f of Eq. 1, s = f(z): from the latent space to scenes.

    `seed` draws the fixed anchors of the latent sphere; `void` is the layout decoder's.
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
        self.shape = config.shape.build(2 * width)

    @property
    def faces(self) -> Int[Tensor, "faces 3"] | None:
        """The triangles of all decoded meshes; None where shapes are looks."""
        return None if isinstance(self.shape, OccupancyDecoder) else self.shape.faces

    def forward(
        self, logits: Float[Tensor, "rooms logits"], with_shape: bool = True
    ) -> DecodedScenes:
        """Decode rooms from the logits of their latent weights."""
        return self.decode(self.latent_space(logits), with_shape)

    def decode(
        self,
        z: Float[Tensor, "rooms width"],
        with_shape: bool | Bool[Tensor, "rooms shaped"] = True,
        wanted: Bool[Tensor, "rooms wanted"] | None = None,
    ) -> DecodedScenes:
        """Decode rooms from points of the latent space; `with_shape` adds meshes or looks.

        Meshes may be asked for of some objects alone: the others' vertices lie at their box's
        centre. `wanted` decodes as many objects as it has columns, and meshes where it is true;
        behind a room's last wanted object all else means nothing. None: all N.

        Layouts stay float32 under autocast: bfloat16 would round 3 m to steps of 2 cm.
        """
        count = self.max_objects if wanted is None else wanted.shape[1]
        needed = None
        if wanted is not None:
            numbers = torch.arange(1, wanted.shape[1] + 1, device=wanted.device)
            needed = (wanted * numbers).amax(dim=1)
        features = self.decoder(z, count, needed)
        with torch.autocast(z.device.type, enabled=False):
            layout, shared = self.layout(features.to(z.dtype))
        scenes = DecodedScenes(**layout._asdict(), bevels=self.bevels(layout.class_logits))
        if isinstance(self.shape, OccupancyDecoder):
            codes = self.shape(shared).to(z.dtype)
            looks = None if with_shape is False else self.shape.looks(codes)
            return replace(scenes, shape_codes=codes, looks=looks)
        if with_shape is False:
            return scenes
        shaped = wanted if with_shape is True else with_shape
        if shaped is None:
            shapes = self.shape(shared).to(z.dtype)
        else:
            shaped = F.pad(shaped, (0, count - shaped.shape[1]))
            some = self.shape(shared[shaped].unsqueeze(0))[0].to(z.dtype)
            shapes = some.new_full((*shaped.shape, *some.shape[1:]), self.shape.nothing)
            shapes = shapes.index_put((shaped,), some)
        return replace(scenes, vertices_m=place(shapes, layout.centers_m, layout.sizes_m))
