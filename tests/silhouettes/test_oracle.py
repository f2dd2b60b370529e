"""Against PyTorch3D: silhouettes and gradients kept in shared/data/oracle_silhouettes.npz."""

from pathlib import Path

import numpy as np
import pytest
import torch

from sceneprior.silhouettes.render import render_silhouettes, sigma_from_ndc

ORACLE = Path(__file__).resolve().parents[3] / "shared" / "data" / "oracle_silhouettes.npz"
pytestmark = pytest.mark.skipif(
    not ORACLE.is_file(), reason=f"no {ORACLE.parent.name}/{ORACLE.name} beside the repository"
)
SIZES = ["90x120", "180x240"]


def render(data, tag: str, dtype: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Masks (views, objects, H, W) and, per view, d sum(mask * weights) / d vertices.

    One room a view, so that gradients stay apart.
    """
    height, width = map(int, tag.split("x"))
    views = len(data["R"])
    poses = torch.eye(4, dtype=dtype).repeat(views, 1, 1, 1)
    poses[:, 0, :3, :3] = torch.from_numpy(data["R"])
    poses[:, 0, :3, 3] = torch.from_numpy(data["t"])
    lens = torch.from_numpy(data[f"K_{tag}"]).to(dtype).expand(views, 1, 3, 3)
    vertices = torch.from_numpy(data["verts"]).to(dtype).repeat(views, 1, 1, 1).requires_grad_()
    masks = render_silhouettes(
        vertices,
        torch.from_numpy(data["faces"]).long(),
        poses,
        lens,
        (height, width),
        sigma_px2=sigma_from_ndc(float(data["sigma"]), (height, width)),
        compositing="alone",
    )[:, 0]
    weights = torch.from_numpy(data[f"weights_int8_{tag}"]).to(dtype).transpose(0, 1) / 64
    (masks * weights).sum().backward()
    return masks.detach(), vertices.grad


@pytest.mark.parametrize("tag", SIZES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_silhouettes_and_gradients_are_pytorch3ds(tag, dtype):
    with np.load(ORACLE) as data:
        masks, gradients = render(data, tag, dtype)
        alpha = data[f"alpha_nocap_A_{tag}"].swapaxes(0, 1)
        wanted = data[f"grad_nocap_A_{tag}"].swapaxes(0, 1)
        # (objects, views): where PyTorch3D dropped no face.
        whole = (data["z_min"] > 0.06).T
    assert whole.sum() == 11
    np.testing.assert_allclose(masks.numpy()[whole], alpha[whole], rtol=0, atol=1e-4)
    assert (alpha[whole].max(axis=(1, 2)) > 0.99).all()
    # Relative to the largest pull of the object in the view.
    scale = np.abs(wanted[whole]).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(
        gradients.numpy()[whole] / scale, wanted[whole] / scale, rtol=0, atol=1e-3
    )
