"""The whole prior: latent logits in, decoded scenes out."""

from jaxtyping import Float
from torch import Tensor, nn

from sceneprior.batches import DecodedScenes
from sceneprior.geometry.boxes import place
from sceneprior.models.latents import LatentSphere
from sceneprior.models.layout_decoder import LayoutDecoder
from sceneprior.models.scene_decoder import SceneDecoder
from sceneprior.models.shape_decoder import ShapeDecoder


class ScenePrior(nn.Module):
    """f of equation 1: from the hypersphere to scenes.

    Args:
        classes: Size of the label set.
        max_objects: N, how many objects are unrolled.
        width: D_z.
        anchors: M fixed vectors of the latent hypersphere.
        heads, hidden, dropout: Of the transformer.
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
        shape_width: int = 256,
        shape_level: int = 4,
        template: str = "sphere",
        fit_box: bool = False,
        seed: int = 0,
    ):
        super().__init__()
        self.max_objects = max_objects
        self.sphere = LatentSphere(anchors, width, seed)
        self.decoder = SceneDecoder(width, heads, hidden, dropout)
        self.layout = LayoutDecoder(width, classes)
        self.shape = ShapeDecoder(2 * width, shape_width, shape_level, template, fit_box)

    def forward(
        self, logits: Float[Tensor, "rooms anchors"], with_shape: bool = True
    ) -> DecodedScenes:
        """Decode rooms from the logits of their latent weights."""
        return self.decode(self.sphere(logits), with_shape)

    def decode(self, z: Float[Tensor, "rooms width"], with_shape: bool = True) -> DecodedScenes:
        """Decode rooms from points on the hypersphere; `with_shape` adds meshes."""
        features = self.decoder(z, self.max_objects)
        layout, shared = self.layout(features)
        vertices = None
        if with_shape:
            vertices = place(self.shape(shared), layout.centers_m, layout.sizes_m)
        return DecodedScenes(
            class_logits=layout.class_logits,
            centers_m=layout.centers_m,
            sizes_m=layout.sizes_m,
            completeness_logits=layout.completeness_logits,
            vertices_m=vertices,
        )
