"""The view loss of decoded scenes: 2D boxes, matching, and rendered masks."""

from collections.abc import Callable

from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional as F

from sceneprior.core.cameras import Boxes2D, boxes_of_points
from sceneprior.core.proxies import beveled_cube, boxes_of_ellipsoids, place
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.losses import layout_losses
from sceneprior.paper.matching import Matches, match_objects
from sceneprior.paper.settings import LossConfig, ShapeConfig
from sceneprior.render.silhouettes.render import render_silhouettes
from sceneprior.training.steps import check_finite, weighted_sum


def proxy_boxes(scenes: DecodedScenes, views: SceneViews, proxy: str) -> Boxes2D:
    """2D boxes of objects without a mesh, computed from the shape that `StageConfig.proxy` names.

    In a room with n tracked objects, only the first n predictions get a box, as in `seen_boxes`.
    """
    objects = (scenes.centers_m, scenes.sizes_m)
    if proxy == "ellipsoid":
        return _of_first(boxes_of_ellipsoids, views, *objects)
    assert scenes.bevels is not None, "decode() gives every object bevels"
    return _of_first(boxes_of_points, views, place(beveled_cube(scenes.bevels), *objects))


def first_predictions(views: SceneViews, slots: int) -> Bool[Tensor, "rooms slots"]:
    """Mask of the first n predictions of each room with n tracked objects: only these are
    matched."""
    return F.pad(views.is_object, (0, slots - views.is_object.shape[1]))


def _of_first(project: Callable[..., Boxes2D], views: SceneViews, *objects: Tensor) -> Boxes2D:
    """Project only the predictions that are matched (`first_predictions`). The others get empty
    boxes, and count as outside the frustum."""
    rooms, slots = objects[0].shape[:2]
    first = first_predictions(views, slots)
    room = first.nonzero()[:, 0]
    # Each prediction is projected as a room with a single object.
    cameras = (views.world_to_camera[room], views.intrinsics[room], views.image_size)
    boxes, inside = project(*(values[first].unsqueeze(1) for values in objects), *cameras)
    return Boxes2D(*(
        of.new_zeros(rooms, slots, *of.shape[1:2], *of.shape[3:])
        .index_put((first,), of[:, :, 0])
        .transpose(1, 2)
        for of in (boxes, inside)
    ))  # fmt: skip


def match_and_score(
    scenes: DecodedScenes,
    boxes: Boxes2D,
    views: SceneViews,
    weights: LossConfig,
    completeness_target: str | None,
) -> tuple[dict[str, Float[Tensor, "*rooms"]], Matches]:
    """Match predictions to tracked objects by class and 2D box, and compute the layout losses.

    `completeness_target` is explained in `layout_losses`. The losses are checked here, before
    anything is rendered, since the renderer's own error for vertices that are not finite names no
    room.

    Raises:
        FloatingPointError: the weighted sum of these losses is not finite.
    """
    matches = match_objects(scenes, boxes, views, weights.match_box, weights.occlusion_slack)
    losses = layout_losses(
        scenes, boxes, views, matches, weights.occlusion_slack, completeness_target
    )
    check_finite(weighted_sum(losses, weights).detach().sum(), views.room_ids)
    return losses, matches


def seen_boxes(scenes: DecodedScenes, views: SceneViews, settings: ShapeConfig | None) -> Boxes2D:
    """2D boxes of decoded objects, computed from their meshes if there are any
    (`ShapeConfig.box_from`).

    In a room with n tracked objects, only the first n predictions, which are matched, get a box;
    the others get empty boxes, and count as outside the frustum.
    """
    if settings is None:
        return proxy_boxes(scenes, views, "ellipsoid")
    if scenes.vertices_m is None or settings.box_from == "proxy":
        return proxy_boxes(scenes, views, settings.proxy)
    return _of_first(boxes_of_points, views, scenes.vertices_m)


def seen_masks(
    vertices_m: Float[Tensor, "rooms objects vertices 3"],
    faces: Int[Tensor, "faces 3"],
    views: SceneViews,
    settings: ShapeConfig,
) -> Float[Tensor, "rooms views objects height width"]:
    """Soft visible masks of decoded objects, at the size of the views' instance ids.

    In a room of n objects, only the first n predictions, which are matched, are rendered; the
    others would occlude them.
    """
    height, width = views.observed_ids.shape[-2:]
    return render_silhouettes(
        vertices_m,
        faces,
        views.world_to_camera,
        views.intrinsics_at(height, width),
        (height, width),
        sigma_px2=settings.sigma_px2,
        mode=settings.silhouettes,
        compositing=settings.compositing,
        drawn=first_predictions(views, vertices_m.shape[1]),
    )
