"""The set flow with 3D supervision: its config, and its training by flow matching."""

from typing import Literal

import torch
from jaxtyping import Bool, Float
from pydantic import Field
from torch import Tensor

from sceneprior.baselines.one_stage import OneStage, OneStageTraining
from sceneprior.baselines.set_flow.network import NUMBERS, PARTS, SetFlow, SetFlowModel
from sceneprior.baselines.true_boxes import BoxConfig, room_means
from sceneprior.core.views import RoomBoxes
from sceneprior.paper.matching import assign
from sceneprior.training.steps import full_precision


class SetFlowTraining(OneStageTraining):
    """Training settings of the set flow."""

    epochs: int = Field(500, ge=1)
    batch_size: int = Field(64, ge=1)
    learning_rate: float = Field(1e-3, gt=0)


class SetFlowConfig(BoxConfig):
    """Config of a run of the set flow."""

    method: Literal["set_flow"] = "set_flow"
    model: SetFlowModel
    training: SetFlowTraining = SetFlowTraining()

    def make(self) -> "SetFlowStage":
        return SetFlowStage(SetFlow(self.model, self.classes), self.training)


class SetFlowStage(OneStage):
    """Training by flow matching. The loss of a room sums, over its objects, half the squared error
    of the velocity from noise to the training room, and the cross-entropy of the class."""

    prior: SetFlow

    def training_step(self, rooms: RoomBoxes, batch_idx: int) -> Tensor:
        is_object = rooms.is_object
        tokens = self.prior.to_tokens(rooms)
        # `StepSeed` seeds noise and times by the step, so that a resumed run draws the same ones.
        noise = matched(torch.randn_like(tokens), tokens, is_object)
        time = torch.rand_like(tokens[:, 0, 0])
        between = torch.lerp(noise, tokens, time[:, None, None])
        velocity, logits = self.prior.predict(between, time, is_object)
        with full_precision(self.device):
            halved = (velocity.float() - (tokens - noise)[..., :NUMBERS]) ** 2 / 2
            halved = halved * is_object.unsqueeze(-1)
            losses = {name: halved[..., part].sum(dim=(1, 2)) for name, part in PARTS.items()}
            true = (rooms.object_class - 1).clamp(min=0).unsqueeze(-1)
            entropy = -logits.float().log_softmax(dim=-1).gather(-1, true)[..., 0]
            losses["class"] = (entropy * is_object).sum(dim=1)
            return self.total(room_means(losses, rooms), {}, rooms)


def matched(
    noise: Float[Tensor, "rooms objects token"],
    tokens: Float[Tensor, "rooms objects token"],
    is_object: Bool[Tensor, "rooms objects"],
) -> Float[Tensor, "rooms objects token"]:
    """Reorder the noise of each room so that the summed squared distance to the objects is minimal.

    Rooms are sets, so that any order of the noise is a valid start, and straight paths that do not
    cross are learnt faster (Song et al., "Equivariant Flow Matching with Hybrid Probability
    Transport", NeurIPS 2023).
    """
    counts = is_object.sum(dim=1).tolist()
    order = assign(torch.cdist(noise, tokens) ** 2, counts, counts)
    return torch.take_along_dim(noise, order.unsqueeze(-1), dim=1)
