"""What tests of metrics share: torchmetrics' side of a comparison, and rooms of unit boxes."""

import numpy as np
import torch

from sceneprior.scene import Scene, SceneObject

UNIT = (1.0, 1.0, 1.0)


class Plain(torch.nn.Module):
    """A feature network whose features are its inputs, as torchmetrics wants one."""

    num_features = 12

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return rows[:, :, 0, 0].double()


def fed(metric, a: np.ndarray, b: np.ndarray):
    for rows, real in ((b, True), (a, False)):
        metric.update(torch.from_numpy(rows)[:, :, None, None].expand(-1, -1, 3, 3), real=real)
    return metric.compute()


def room(*items: tuple[str, tuple[float, float, float]], sizes=None) -> Scene:
    sizes = sizes or [UNIT] * len(items)
    objects = [
        SceneObject(label, tuple(map(float, at)), tuple(map(float, size)))
        for (label, at), size in zip(items, sizes, strict=True)
    ]
    return Scene("room", "front3d_bedroom", tuple(objects))


def of_classes(*labels: str) -> Scene:
    return room(*((label, (3.0 * index, 0.5, 0.0)) for index, label in enumerate(labels)))
