"""The parts of a training step whose tensors have the same shapes in every batch, as CUDA graphs.

A step of the network launches thousands of small kernels, and Python takes longer to launch them
than a GPU takes to run them. Here all rooms go through all N steps of the transformer, the boxes of
all predictions are computed, and the last batch of an epoch is padded (`SceneViews.padded`), so
that the launches are the same in every step.
"""

from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sceneprior.core.cameras import Boxes2D
from sceneprior.core.views import DecodedScenes, SceneViews
from sceneprior.paper.losses import matched_losses
from sceneprior.paper.matching import (
    Matches,
    assign,
    matchable,
    matching_cost,
    proxy_boxes,
    seen_boxes,
)
from sceneprior.paper.prior import ScenePrior
from sceneprior.paper.settings import LossConfig, StageConfig
from sceneprior.training.graphs import Captured, OnHost
from sceneprior.training.steps import full_precision

_LAYOUT = ("class_logits", "centers_m", "sizes_m", "completeness_logits", "bevels")
_VIEWS = (
    "room_index", "object_class", "is_object", "world_to_camera", "intrinsics", "boxes", "visible",
    "sides_clear",
)  # fmt: skip


class StaticStep:
    """Layouts, boxes, matching and layout losses of padded batches (`padded`).

    The assignment between predictions and objects is solved on the host, which waits for the GPU
    there, and nowhere else.
    """

    def __init__(
        self, prior: ScenePrior, stage: StageConfig, weights: LossConfig, completeness_target: str
    ):
        self.prior, self.stage, self.weights = prior, stage, weights
        self.completeness_target = completeness_target
        self._layouts = Captured("the decoder", _Layouts(prior))
        self._boxes = Captured("the 2D boxes", self._boxes_of)
        self._cost = Captured("the matching cost", self._cost_of)
        self._losses = Captured("the layout losses", self._losses_of)
        self._template: SceneViews | None = None

    def padded(self, views: SceneViews) -> SceneViews:
        """A batch on the host, as this step takes it, with its counts and indices."""
        views = views.padded(self.stage.batch_size, self.prior.max_objects)
        _ = views.object_counts, views.object_places, views.seen_places
        return views

    def prepare(self, z: Float[Tensor, "rooms width"], views: SceneViews) -> None:
        """Capture the graphs, in the first step. The decoder, which draws random numbers, comes
        last: a failure before it does not affect it."""
        if self._template is not None:
            return
        self._template = replace(views, instance_ids=None, room_ids=())
        state = torch.cuda.get_rng_state(z.device) if z.is_cuda else torch.get_rng_state()
        scenes, _ = self.layouts(z)
        with full_precision(z.device):
            boxes = self.boxes(scenes, views)
            layout, seen = _parts(scenes, _LAYOUT), _parts(views, _VIEWS)
            prediction = torch.zeros_like(views.object_class)
            self._losses.capture(*layout, *boxes, prediction, *seen)
            self._boxes.capture(*layout, *seen)
            self._cost.capture(*(part.detach() for part in (*layout, *boxes)), *seen)
        if z.is_cuda:
            torch.cuda.set_rng_state(state, z.device)
        else:
            torch.set_rng_state(state)
        self._layouts.capture(z)

    def layouts(
        self, z: Float[Tensor, "rooms width"]
    ) -> tuple[DecodedScenes, Float[Tensor, "rooms objects features"]]:
        """The decoded rooms without shapes, and the features from which shapes are decoded."""
        *layout, shared = self._layouts(z)
        return DecodedScenes(*layout), shared

    def boxes(self, scenes: DecodedScenes, views: SceneViews, box_from: str = "proxy") -> Boxes2D:
        """2D boxes of all predictions, or of those of `seen_boxes` if they are boxes of meshes."""
        if box_from == "mesh":
            return seen_boxes(scenes, views, self.stage.proxy, box_from)
        return Boxes2D(*self._boxes(*_parts(scenes, _LAYOUT), *_parts(views, _VIEWS)))

    def cost(self, scenes: DecodedScenes, boxes: Boxes2D, views: SceneViews) -> OnHost:
        """The matching cost, on its way to the host."""
        layout = (part.detach() for part in (*_parts(scenes, _LAYOUT), *boxes))
        return OnHost(self._cost(*layout, *_parts(views, _VIEWS)))

    def matches(self, cost: OnHost, views: SceneViews) -> Matches:
        """The assignment of least cost; waits for the cost."""
        counts = views.object_counts
        prediction = assign(cost.read()[0], counts, counts)
        if views.boxes.is_cuda:
            prediction = prediction.pin_memory().to(views.boxes.device, non_blocking=True)
        return Matches(prediction, matchable(views))

    def losses(
        self, scenes: DecodedScenes, boxes: Boxes2D, views: SceneViews, matches: Matches
    ) -> dict[str, Float[Tensor, ""]]:
        """The terms of `layout_losses`, without its check."""
        values = self._losses(
            *_parts(scenes, _LAYOUT), *boxes, matches.prediction, *_parts(views, _VIEWS)
        )
        return dict(zip(("class", "box", "completeness", "frustum"), values.unbind(), strict=True))

    def _boxes_of(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        scenes, views = DecodedScenes(*tensors[:5]), self._views(tensors[5:])
        return tuple(proxy_boxes(scenes, views, self.stage.proxy))

    def _cost_of(self, *tensors: Tensor) -> Float[Tensor, "rooms predictions objects"]:
        scenes, boxes = DecodedScenes(*tensors[:5]), Boxes2D(*tensors[5:7])
        weights = self.weights.match_box, self.weights.occlusion_slack
        return matching_cost(scenes, boxes, self._views(tensors[7:]), *weights)

    def _losses_of(self, *tensors: Tensor) -> Float[Tensor, "4"]:
        scenes, boxes = DecodedScenes(*tensors[:5]), Boxes2D(*tensors[5:7])
        prediction, views = tensors[7], self._views(tensors[8:])
        matches = Matches(prediction, matchable(views))
        settings = self.weights, self.completeness_target
        return torch.stack([*matched_losses(scenes, boxes, views, matches, *settings).values()])

    def _views(self, tensors: tuple[Tensor, ...]) -> SceneViews:
        assert self._template is not None, "prepare() comes first"
        named: dict[str, Any] = dict(zip(_VIEWS, tensors, strict=True))
        return replace(self._template, **named)


class _Layouts(nn.Module):
    def __init__(self, prior: ScenePrior):
        super().__init__()
        self.prior = prior

    def forward(self, z: Tensor) -> tuple[Tensor, ...]:
        scenes, shared = self.prior.layouts(z, self.prior.max_objects)
        return *_parts(scenes, _LAYOUT), shared


def _parts(batch: DecodedScenes | SceneViews, names: tuple[str, ...]) -> tuple[Tensor, ...]:
    return tuple(getattr(batch, name) for name in names)
