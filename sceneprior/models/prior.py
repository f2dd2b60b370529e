"""The whole prior: latent logits in, decoded scenes out."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from sceneprior.baselines.atiss2d import SceneAtiss
from sceneprior.baselines.lstm import SceneLstm
from sceneprior.geometry.boxes import place
from sceneprior.models.bevels import ClassBevels
from sceneprior.models.latents import LatentCube, LatentSpace, LatentSphere
from sceneprior.models.layout_decoder import LayoutDecoder
from sceneprior.models.shape_decoder import ShapeDecoder
from sceneprior.models.transformer import SceneDecoder
from sceneprior.views import DecodedScenes


class ScenePrior(nn.Module):
    """f of equation 1: from the latent space to scenes.

    `sphere` is the latent space, which is a sphere unless `latent` says otherwise.

    Args:
        classes: Size of the label set.
        max_objects: N, how many objects are unrolled.
        width: D_z.
        anchors: M fixed vectors of the latent hypersphere.
        latent: `sphere`, or `uniform` for a cube of logits (ablation c1).
        decoder: `transformer`, `lstm` (ablation c2), or `atiss` (baseline ATISS-2D).
        encoder_layers, norm_first: Of the encoder of `atiss`.
        heads, hidden, dropout: Of the transformer, and of the encoder of `atiss`.
        final_norm, query_self_attention: Of the transformer.
        step_mlps: Whether each of the transformer's N steps ends in an MLP of its own.
        layout_heads, void: Of the layout decoder.
        shape_width, shape_level, template, fit_box: Of the shape decoder.
        seed: Draws the fixed latent anchors.
    """

    def __init__(
        self,
        classes: int,
        max_objects: int = 13,
        width: int = 512,
        anchors: int = 100,
        heads: int = 4,
        hidden: int = 1024,
        dropout: float = 0.1,
        latent: str = "sphere",
        decoder: str = "transformer",
        encoder_layers: int = 4,
        norm_first: bool = False,
        final_norm: bool = False,
        query_self_attention: bool = False,
        step_mlps: bool = False,
        layout_heads: str = "joint",
        void: bool = True,
        shape_width: int = 256,
        shape_level: int = 4,
        template: str = "sphere",
        fit_box: bool = False,
        seed: int = 0,
    ):
        super().__init__()
        self.max_objects = max_objects
        self.latent_space: LatentSpace
        if latent == "uniform":
            self.latent_space = LatentCube(width)
        else:
            self.latent_space = LatentSphere(anchors, width, seed)
        self.decoder: SceneDecoder | SceneLstm | SceneAtiss
        if decoder == "lstm":
            self.decoder = SceneLstm(width)
        elif decoder == "atiss":
            self.decoder = SceneAtiss(width, heads, hidden, dropout, encoder_layers, norm_first)
        else:
            steps = max_objects if step_mlps else 0
            self.decoder = SceneDecoder(
                width, heads, hidden, dropout, final_norm, query_self_attention, steps
            )
        self.layout = LayoutDecoder(width, classes, heads=layout_heads, void=void)
        self.bevels = ClassBevels(classes)
        self.shape = ShapeDecoder(2 * width, shape_width, shape_level, template, fit_box)

    def forward(
        self, logits: Float[Tensor, "rooms anchors"], with_shape: bool = True
    ) -> DecodedScenes:
        """Decode rooms from the logits of their latent weights."""
        return self.decode(self.latent_space(logits), with_shape)

    def decode(
        self,
        z: Float[Tensor, "rooms width"],
        with_shape: bool = True,
        wanted: Bool[Tensor, "rooms wanted"] | None = None,
    ) -> DecodedScenes:
        """Decode rooms from points of the latent space; `with_shape` adds meshes.

        `wanted` saves work where a room's first few objects are all that is looked at: as many
        objects are unrolled as it has columns, and a mesh is made of those it marks; the others'
        vertices all lie in the middle of their boxes. None wants all N.

        Under autocast the transformer and the shape decoder run in mixed precision. What is
        said in metres does not: in bfloat16 3 m is followed by 3.02 m.
        """
        count = self.max_objects if wanted is None else wanted.shape[1]
        features = self.decoder(z, count)
        with torch.autocast(z.device.type, enabled=False):
            layout, shared = self.layout(features.to(z.dtype))
        vertices = None
        if with_shape:
            if wanted is None:
                canonical = self.shape(shared).to(z.dtype)
            else:
                some = self.shape(shared[wanted].unsqueeze(0))[0].to(z.dtype)
                canonical = some.new_zeros(*wanted.shape, *some.shape[1:])
                canonical = canonical.index_put((wanted,), some)
            vertices = place(canonical, layout.centers_m, layout.sizes_m)
        return DecodedScenes(
            class_logits=layout.class_logits,
            centers_m=layout.centers_m,
            sizes_m=layout.sizes_m,
            completeness_logits=layout.completeness_logits,
            bevels=self.bevels(layout.class_logits),
            vertices_m=vertices,
        )
