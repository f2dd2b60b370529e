"""Draw the figures of docs/silhouettes.md.

python benchmarks/plot_silhouettes.py [--out docs/images]
"""

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from bench_silhouettes import furnished_room

from sceneprior.core.meshes import icosphere
from sceneprior.render.silhouettes import render_scene, render_silhouettes

RADIUS_PX = 12.0
STEP_PX = 0.05


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    plot_profiles(out / "silhouettes_profile.png")
    plot_room(out / "silhouettes_room.png")


def disc(level: int, mode: str, radius_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Coverage of a small distant sphere, and each pixel's signed distance to its circle of
    RADIUS_PX, positive outside."""
    sphere, faces = icosphere(level)
    focal, depth = 1000.0, 100.0
    intrinsics = torch.tensor([[focal, 0, 20.13], [0, focal, 15.37], [0, 0, 1]]).double()
    vertices = sphere.double() * (radius_px * depth / focal) + torch.tensor([0, 0, depth])
    masks = render_silhouettes(
        vertices[None, None],
        faces,
        torch.eye(4).double()[None, None],
        intrinsics[None, None],
        (30, 40),
        sigma_px2=0.2025,  # the paper's sigma at 120 x 90
        mode=mode,
    )
    rows, columns = np.mgrid[:30, :40] + 0.5
    outside = np.hypot(columns - 20.13, rows - 15.37) - RADIUS_PX
    return masks[0, 0, 0].numpy().ravel(), outside.ravel()


def plot_profiles(path: Path) -> None:
    """Plot coverage, and its derivative with respect to the radius, across a sphere's outline."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.5, 3.4), layout="constrained")
    for mode, line in (("exact", "-"), ("fast", "--")):
        for level, color in ((2, "tab:blue"), (3, "tab:orange"), (4, "tab:green")):
            coverage, outside = disc(level, mode, RADIUS_PX)
            grown = disc(level, mode, RADIUS_PX + STEP_PX)[0]
            shrunk = disc(level, mode, RADIUS_PX - STEP_PX)[0]
            bins = np.arange(-4, 2.5, 0.25)
            place = np.digitize(outside, bins)
            filled = [place == k for k in range(1, len(bins)) if (place == k).any()]
            middle = [outside[here].mean() for here in filled]
            label = f"{mode}, {20 * 4**level:,} faces"
            for axis, values in ((left, coverage), (right, (grown - shrunk) / (2 * STEP_PX))):
                mean = [
                    values[place == k].mean() for k in range(1, len(bins)) if (place == k).any()
                ]
                axis.plot(middle, mean, line, color=color, label=label, linewidth=1.5)
    left.set(xlabel="pixels outside the outline", ylabel="coverage")
    right.set(xlabel="pixels outside the outline", ylabel="gain of coverage per pixel of growth")
    for axis in (left, right):
        axis.axvline(0, color="gray", linewidth=0.7)
    left.legend(frameon=False, fontsize=7.5)
    figure.savefig(path, dpi=130)


def plot_room(path: Path) -> None:
    """Plot one view of the benchmark's room: front-most objects, and both compositing modes."""
    room = furnished_room(3)
    room = room | {key: room[key][:, 3:4] for key in ("world_to_camera", "intrinsics")}
    colors = torch.from_numpy(plt.get_cmap("tab20")(np.arange(13))[:, :3]).float()
    figure, axes = plt.subplots(1, 4, figsize=(12, 2.7), layout="constrained")
    front = render_scene(**room).front[0, 0]
    picture = torch.where(front[..., None] >= 0, colors[front.clamp(min=0).long()], 1.0)
    axes[0].imshow(picture)
    axes[0].set_title("front-most object", fontsize=9)
    variants = (("exact", "paper"), ("exact", "layered"), ("fast", "layered"))
    for axis, (mode, compositing) in zip(axes[1:], variants, strict=True):
        masks = render_silhouettes(**room, mode=mode, compositing=compositing)[0, 0]
        picture = 1 - (masks[..., None] * (1 - colors[:, None, None])).sum(dim=0)
        axis.imshow(picture.clamp(0, 1)[30:75, 30:90])
        axis.set_title(f"{mode}, {compositing} (part)", fontsize=9)
    for axis in axes:
        axis.set_xticks([])
        axis.set_yticks([])
    figure.savefig(path, dpi=130)


if __name__ == "__main__":
    main()
