"""Poses in, poses a little moved out: what training learns of each view's pose error."""

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class CameraCorrection(nn.Module):
    """A small rigid motion for each view of the data set, in the camera's own frame.

        corrected = exp(scale * twist) @ world_to_camera,  twist in se(3)

    All twists start at zero, where nothing is moved. In the camera's frame a correction is the same
    for a room and its turned copies, which share it.

    Args:
        views: Of the data set, over all rooms.
        scale: Radians and metres of a twist of length one: how far off poses are thought to be.
    """

    def __init__(self, views: int, scale: float):
        super().__init__()
        self.scale = scale
        self.twists = nn.Embedding.from_pretrained(torch.zeros(views, 6), freeze=False)

    def forward(
        self,
        world_to_camera: Float[Tensor, "rooms views 4 4"],
        view: Int[Tensor, "rooms views"],
    ) -> tuple[Float[Tensor, "rooms views 4 4"], Float[Tensor, ""]]:
        """Corrected poses, and the mean square of what moved them (in units of `scale`)."""
        twist = self.twists(view)
        motion = torch.linalg.matrix_exp(self.scale * se3_matrix(twist))
        return motion @ world_to_camera, twist.square().sum(dim=-1).mean()


def se3_matrix(twist: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch 4 4"]:
    """The generator of a rigid motion: rotation vector first, then translation."""
    x, y, z, *move = twist.unbind(dim=-1)
    zero = torch.zeros_like(x)
    rows = [[zero, -z, y, move[0]], [z, zero, -x, move[1]], [-y, x, zero, move[2]], [zero] * 4]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
