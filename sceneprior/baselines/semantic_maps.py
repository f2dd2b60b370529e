"""Semantic maps, the share of each class per pixel: of observed views, of generated scenes, and the
discriminator that compares them."""

from collections.abc import Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils.parametrizations import spectral_norm

from sceneprior.core.cameras import project
from sceneprior.core.classes import VOID
from sceneprior.core.errors import InputError
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.decoders import mlp
from sceneprior.render.silhouettes.render import render_scene

POOLING = 2
"""Side of a map's pixel, in pixels of the instance ids. Pooling softens the hard edges of real
maps, which would otherwise distinguish them from rendered ones."""
SIGMA_PX2 = 0.25
"""Softness of rendered edges, chosen to match pooled hard edges: coverage rises from 0.27 to 0.73
between half a pixel outside and half a pixel inside."""
SLOPE = 0.2
"""Slope of the leaky ReLUs."""
SMALLEST_PX = 4
"""Minimum side of a map; halving it twice leaves one pixel."""
GAIN = 10
"""Factor on all scores, which spectral normalisation makes small."""
AREA = 10
"""Factor on the pixel shares in `contents`, because such a share is only a few hundredths."""


def observed_maps(
    views: SceneViews, classes: int
) -> Float[Tensor, "rooms views classes height width"]:
    """Maps of the observed views; pixels without an object are `void`."""
    ids = views.observed_ids.long()
    # Id 0 means no object, and the last id means void furniture.
    of_id = F.pad(views.object_class, (1, 1), value=VOID)
    pixels = of_id.gather(1, ids.flatten(1)).view_as(ids)
    maps = F.one_hot(pixels, classes).movedim(-1, 2).to(views.intrinsics.dtype)
    return F.avg_pool2d(maps.flatten(0, 1), POOLING).unflatten(0, maps.shape[:2])


def rendered_maps(
    scenes: DecodedScenes,
    faces: Int[Tensor, "faces 3"],
    views: SceneViews,
    kept: Float[Tensor, "rooms objects"],
    classes: Float[Tensor, "rooms objects classes"],
    mode: str,
) -> Float[Tensor, "rooms views classes height width"]:
    """Maps of decoded scenes, one scene per room, rendered in the cameras of the views.

    They have the size of observed maps. `kept` and `classes` come from `choices`; `mode` is passed
    to `render_scene`.
    """
    assert scenes.vertices_m is not None, "decode() adds meshes unless told not to"
    height, width = (side // POOLING for side in views.observed_ids.shape[-2:])
    objects = scenes.vertices_m.shape[1]
    # Each object is rendered as a separate room, so that none hides another.
    alone = render_scene(
        scenes.vertices_m.flatten(0, 1).unsqueeze(1),
        faces,
        views.world_to_camera.repeat_interleave(objects, dim=0),
        views.mask_intrinsics(POOLING).repeat_interleave(objects, dim=0),
        (height, width),  # pooling drops incomplete pixels, too
        sigma_px2=SIGMA_PX2,
        mode=mode,
        compositing="alone",
    )
    coverage = alone.masks[:, :, 0].unflatten(0, (-1, objects)).transpose(1, 2)
    depth_m = alone.depth_m.unflatten(0, (-1, objects)).transpose(1, 2)
    # Pixels covered only by the soft edge have no depth; they get the depth of the object's centre.
    centers = project(scenes.centers_m.unsqueeze(2), views.world_to_camera, views.intrinsics)
    depth_m = depth_m.where(depth_m.isfinite(), centers[..., 2:].detach())
    return compose_maps(coverage, depth_m, kept, classes)


def observed_counts(views: SceneViews, classes: int) -> Float[Tensor, "rooms classes"]:
    """Number of tracked objects of each class in each room."""
    of_objects = F.one_hot(views.object_class.long(), classes) * views.is_object[..., None]
    return of_objects.sum(dim=1).to(views.intrinsics.dtype)


def choices(
    scenes: DecodedScenes, completeness_target: str
) -> tuple[Float[Tensor, "rooms objects"], Float[Tensor, "rooms objects classes"]]:
    """Existence and one-hot class of each object, as `to_rooms` decides them.

    Values are 0 or 1. Gradients are those of sigmoid and softmax (straight-through estimator), so
    that objects which do not exist get gradients, too.
    """
    scores = scenes.completeness_logits.sigmoid()
    shares = scenes.class_logits.softmax(dim=-1)
    likeliest = F.one_hot(shares.argmax(dim=-1), shares.shape[-1])
    kept = kept_share(_straight_through(scores > 0.5, scores), completeness_target)
    return kept, _straight_through(likeliest, shares)


def kept_share(
    scores: Float[Tensor, "rooms slots"], convention: str
) -> Float[Tensor, "rooms slots"]:
    """Probability that each prediction belongs to the scene, if completeness scores are independent
    probabilities.

    If all scores are 0 or 1, this equals `kept_objects`; the gradient with respect to a score is
    then the effect of ending the scene there, or of continuing it.
    """
    if convention == "stop":  # the object whose score ends the scene still belongs to it
        scores = F.pad(1 - scores[:, :-1], (1, 0), value=1.0)
    return scores.cumprod(dim=1)


def _straight_through(hard: Tensor, soft: Tensor) -> Tensor:
    return hard.to(soft) + soft - soft.detach()


def compose_maps(
    coverage: Float[Tensor, "rooms views objects height width"],
    depth_m: Float[Tensor, "rooms views objects height width"],
    kept: Float[Tensor, "rooms objects"],
    classes: Float[Tensor, "rooms objects classes"],
) -> Float[Tensor, "rooms views classes height width"]:
    """Composite objects in each pixel, nearest first.

        visible_k = a_k * prod_{j nearer than k} (1 - a_j),    a_k = kept_k coverage_k

    a_k is the object's coverage when rendered alone, or 0 if the object does not exist. Depths have
    no gradient. `void` gets the rest of the pixel, so that the classes of a map sum to 1.
    """
    alpha = coverage * kept[:, None, :, None, None]
    order = depth_m.argsort(dim=2)
    ordered = alpha.gather(2, order)
    left = (1 - ordered).cumprod(dim=2)
    before = torch.cat([torch.ones_like(left[:, :, :1]), left[:, :, :-1]], dim=2)
    visible = torch.zeros_like(alpha).scatter(2, order, ordered * before)
    maps = torch.einsum("rvkhw,rkc->rvchw", visible, classes)
    maps[:, :, VOID] += left[:, :, -1]
    return maps


class MapDiscriminator(nn.Module):
    """Scores each patch of 18 x 18 pixels of a map, and each room by all of its views.

    Every layer is spectrally normalised, so that the network is about 1-Lipschitz. There is no
    depth channel (supplement, Baselines). Two layers halve the sides; the first has `width`
    channels, the second twice as many.
    """

    def __init__(self, classes: int, width: int = 32):
        super().__init__()
        self.layers = _bounded(
            nn.Conv2d(classes, width, 4, stride=2, padding=1),
            nn.Conv2d(width, 2 * width, 4, stride=2, padding=1),
        )
        self.patch = _bounded(nn.Conv2d(2 * width, 1, 3, padding=1))
        self.room = _bounded(nn.Linear(4 * width, 2 * width), nn.Linear(2 * width, 1))

    def forward(
        self, maps: Float[Tensor, "rooms views classes height width"]
    ) -> tuple[Float[Tensor, "rooms views rows columns"], Float[Tensor, " rooms"]]:
        """Scores of patches and of rooms; higher means more real.

        A room's features are the mean and the maximum over its views, so the order and number of
        views do not matter.
        """
        height, width = maps.shape[-2:]
        if min(height, width) < SMALLEST_PX:
            raise InputError(
                f"Semantic maps of {height} x {width} pixels are too small for the GAN, which "
                f"needs {SMALLEST_PX} x {SMALLEST_PX}; lower data.mask_step, or prepare larger "
                "images."
            )
        x = F.leaky_relu(self.layers(maps.flatten(0, 1)), SLOPE)
        patches = self.patch(x)[:, 0].unflatten(0, maps.shape[:2])
        features = x.mean(dim=(2, 3)).unflatten(0, maps.shape[:2])
        room = torch.cat([features.mean(dim=1), features.amax(dim=1)], dim=-1)
        return GAIN * patches, GAIN * self.room(room)[:, 0]


def _bounded(*layers: nn.Module) -> nn.Sequential:
    return mlp(*(spectral_norm(layer) for layer in layers), slope=SLOPE)


def adversarial_loss(scores: Sequence[Tensor], real: bool) -> Float[Tensor, ""]:
    """Cross entropy of scores as logits of being real, summed over patches and rooms.

    The generator minimises it with `real` true for its own maps: the non-saturating loss of
    Goodfellow et al., "Generative adversarial nets", NeurIPS 2014.
    """
    return torch.stack([F.softplus(-score if real else score).mean() for score in scores]).sum()


def contents(
    maps: Float[Tensor, "rooms views classes height width"], counts: Float[Tensor, "rooms classes"]
) -> Float[Tensor, "rooms both"]:
    """For each class, the number of objects in a room, and `AREA` times the class's share of the
    pixels of all views."""
    return torch.cat([counts, AREA * maps.mean(dim=(1, 3, 4))], dim=-1)
