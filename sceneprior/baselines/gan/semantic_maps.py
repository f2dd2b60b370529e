"""Semantic maps: per pixel the share of each class, of decoded scenes or of what cameras saw."""

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.classes import VOID
from sceneprior.geometry.cameras import project
from sceneprior.silhouettes.render import render_scene
from sceneprior.views import DecodedScenes, SceneViews

POOLING = 2
"""Pixels of the instance ids on the side of one of a map. What is real has hard edges and what is
rendered has soft ones, which would give it away; pooled, both are soft."""

SIGMA_PX2 = 0.25
"""Softness of rendered edges: about that of a hard edge after pooling, from 0.27 to 0.73 within
half a pixel to either side."""


def observed_maps(
    views: SceneViews, classes: int
) -> Float[Tensor, "rooms views classes height width"]:
    """What the views show: the share of each class in a pixel, of `void` where no object is."""
    ids = views.observed_ids.long()
    of_id = F.pad(views.object_class, (1, 0), value=VOID)
    pixels = of_id.gather(1, ids.flatten(1)).view_as(ids)
    maps = F.one_hot(pixels, classes).movedim(-1, 2).to(views.intrinsics.dtype)
    return F.avg_pool2d(maps.flatten(0, 1), POOLING).unflatten(0, maps.shape[:2])


def rendered_maps(
    scenes: DecodedScenes,
    faces: Int[Tensor, "faces 3"],
    views: SceneViews,
    kept: Float[Tensor, "rooms objects"],
    classes: Float[Tensor, "rooms objects classes"],
    mode: str = "fast",
) -> Float[Tensor, "rooms views classes height width"]:
    """What the views would show of as many other scenes, drawn into the views' cameras.

    Maps are pooled as those of `instance_ids` are; `kept` and `classes` are `choices`, `mode` is
    that of `render_silhouettes`.
    """
    assert scenes.vertices_m is not None, "decode() adds meshes unless told not to"
    height, width = (side / POOLING for side in views.observed_ids.shape[-2:])
    objects = scenes.vertices_m.shape[1]
    # Each object is drawn as a room of its own: whole, with its own depth.
    alone = render_scene(
        scenes.vertices_m.flatten(0, 1).unsqueeze(1),
        faces,
        views.world_to_camera.repeat_interleave(objects, dim=0),
        views.intrinsics_at(height, width).repeat_interleave(objects, dim=0),
        (int(height), int(width)),  # as pooling, which leaves out what does not fill a pixel
        sigma_px2=SIGMA_PX2,
        mode=mode,
        compositing="alone",
    )
    coverage = alone.masks[:, :, 0].unflatten(0, (-1, objects)).transpose(1, 2)
    depth_m = alone.depth_m.unflatten(0, (-1, objects)).transpose(1, 2)
    # Where only the soft edge reaches, the object is as far away as its centre.
    centers = project(scenes.centers_m.unsqueeze(2), views.world_to_camera, views.intrinsics)
    depth_m = depth_m.where(depth_m.isfinite(), centers[..., 2:].detach())
    return compose_maps(coverage, depth_m, kept, classes)


def observed_counts(views: SceneViews, classes: int) -> Float[Tensor, "rooms classes"]:
    """How many objects of each class were tracked in each room."""
    of_objects = F.one_hot(views.object_class.long(), classes) * views.is_object[..., None]
    return of_objects.sum(dim=1).to(views.intrinsics.dtype)


def choices(
    scenes: DecodedScenes, completeness_target: str = "first_n"
) -> tuple[Float[Tensor, "rooms objects"], Float[Tensor, "rooms objects classes"]]:
    """Which objects exist, and which class each has, as decoding reads them: 0 or 1.

    So what is drawn and counted is what will be generated. Gradients are those of sigmoid and
    softmax (straight through): what does not exist still learns what it would change.
    """
    scores = scenes.completeness_logits.sigmoid()
    shares = scenes.class_logits.softmax(dim=-1)
    likeliest = F.one_hot(shares.argmax(dim=-1), shares.shape[-1])
    kept = kept_share(_straight_through(scores > 0.5, scores), completeness_target)
    return kept, _straight_through(likeliest, shares)


def kept_share(
    scores: Float[Tensor, "rooms slots"], convention: str = "first_n"
) -> Float[Tensor, "rooms slots"]:
    """How likely each prediction belongs to the scene, if each score is the chance of a yes.

    Of scores that are 0 or 1 these are the `kept_objects`, and the gradient of each score is what
    its change would bring about: the end of the scene there, or some objects more.
    """
    if convention == "stop":  # none before it said so
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
    """Lay objects over each other, pixel by pixel, nearest first.

        visible_k = a_k * prod_{j nearer than k} (1 - a_j),    a_k = kept_k coverage_k

    is what the pixel shows of object k, and what is left of it shows nothing: `void`.

    a_k is in [0, 1], each object drawn alone; its depth carries no gradient. Of the classes, whose
    shares sum to 1, none is `void`; those of the maps sum to 1, too.
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
