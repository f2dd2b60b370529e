"""Which silhouettes teach shapes best, with no network in between? Meshes fitted to masks.

    sceneprior make-homes out/fit/homes --rooms 48 --room-type bedroom --seed 0
    sceneprior prep-front --front out/fit/homes/3D-FRONT --future out/fit/homes/3D-FUTURE-model \
        --recipe bedroom --out out/fit/shards
    python benchmarks/fit_shapes.py --shards out/fit/shards --rooms 24 --steps 150 --seed 0

Every object starts as a sphere in its true box, moved by about 15 cm and scaled by about a
quarter, and its vertices and box follow the mask loss alone (views with masks at 120 x 90, the
paper's sigma). All variants take the same steps on the same views from the same start. Judged are
views that were never fitted: IoU of each object's visible hard mask, and IoU of the mesh's bounding
box with the true one. --image-step is the share of the pixels that is kept.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch

from sceneprior.data.dataset import ViewDataset
from sceneprior.evaluation.metrics.decoded_rooms import box_iou_3d
from sceneprior.geometry.meshes import icosphere, place
from sceneprior.losses.matching import Matches
from sceneprior.losses.shape import mask_loss
from sceneprior.shards import iterate_rooms
from sceneprior.silhouettes import render_scene, render_silhouettes
from sceneprior.views import SceneViews

VARIANTS = ("exact/layered", "exact/paper", "fast/layered", "fast/paper")
BATCH = 8


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shards", type=Path, default=Path("out/demo/shards"))
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--level", type=int, default=2, help="of the icosphere")
    parser.add_argument("--image-step", type=int, default=4)
    parser.add_argument("--variants", nargs="+", default=VARIANTS)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    dataset = ViewDataset(
        arguments.shards, "train", 8, mask_step=arguments.image_step, seed=arguments.seed
    )
    truths = [
        shard.read_ground_truth(room) for shard, room in iterate_rooms(arguments.shards, "train")
    ]
    figures = {}
    for variant in arguments.variants:
        start = time.perf_counter()
        mode, compositing = variant.split("/")
        results = [
            fit_rooms(dataset, truths, list(range(first, min(first + BATCH, arguments.rooms))),
                      mode, compositing, arguments)
            for first in range(0, arguments.rooms, BATCH)
        ]  # fmt: skip
        masks, boxes = (np.concatenate(values) for values in zip(*results, strict=True))
        figures[variant] = {
            "mask_iou": float(masks.mean()),
            "box_iou_3d": float(boxes.mean()),
            "objects": len(boxes),
            "seconds": time.perf_counter() - start,
        }
        print(variant, "  ".join(f"{k} {v:.4g}" for k, v in figures[variant].items()), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


def fit_rooms(dataset, truths, rows, mode, compositing, arguments):
    """Mask IoUs (object, view) of views not fitted and box IoUs of some rooms' objects."""
    views = dataset.__getitems__([(row, 0) for row in rows])
    counts = views.is_object.sum(dim=1).tolist()
    centers, sizes = torch.zeros(2, len(rows), max(counts), 3)
    for slot, (row, count) in enumerate(zip(rows, counts, strict=True)):
        centers[slot, :count] = torch.from_numpy(truths[row].centers_m[:count])
        sizes[slot, :count] = torch.from_numpy(truths[row].sizes_m[:count])
    true_boxes = (centers.numpy(), sizes.numpy())
    generator = torch.Generator().manual_seed(arguments.seed)
    center = (centers + 0.15 * torch.randn(centers.shape, generator=generator)).requires_grad_()
    scale = torch.exp(0.25 * torch.randn(sizes.shape, generator=generator))
    log_size = (sizes.clamp(min=0.02) * scale).log().requires_grad_()
    sphere, faces = icosphere(arguments.level)
    offset = torch.zeros(*centers.shape[:2], *sphere.shape, requires_grad=True)
    rates = [{"params": [center, log_size], "lr": 0.01}, {"params": [offset], "lr": 0.01}]
    optimizer = torch.optim.Adam(rates)

    def vertices() -> torch.Tensor:
        return place(sphere + offset, center, log_size.exp())

    nobody = torch.arange(max(counts)).expand(len(rows), -1)
    matches = Matches(nobody, views.is_object)
    for _ in range(arguments.steps):
        masks = render_silhouettes(
            vertices(), faces, *cameras(views), mode=mode, compositing=compositing,
            drawn=views.is_object,
        )  # fmt: skip
        loss, _ = mask_loss(masks, views, matches, iou_gate=0.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    fresh = dataset.__getitems__([(row, 1) for row in rows])
    with torch.no_grad():
        mesh = vertices()
        front = render_scene(mesh, faces, *cameras(fresh), drawn=views.is_object).front
    room, view, item = fresh.visible.nonzero(as_tuple=True)
    mine = front[room, view] == item[:, None, None]
    seen = fresh.instance_ids[room, view] == (item + 1)[:, None, None]
    both, either = (mine & seen).sum(dim=(1, 2)), (mine | seen).sum(dim=(1, 2))
    low, high = mesh.amin(dim=2).numpy(), mesh.amax(dim=2).numpy()
    box_iou = [
        box_iou_3d((low + high)[r][:n] / 2, (high - low)[r][:n], true_boxes[0][r][:n],
                   true_boxes[1][r][:n]).diagonal()
        for r, n in enumerate(counts)
    ]  # fmt: skip
    return (both / either.clamp(min=1)).numpy(), np.concatenate(box_iou)


def cameras(views: SceneViews) -> tuple[torch.Tensor, torch.Tensor, tuple[int, int]]:
    """Poses, intrinsics and size of the views' mask images."""
    height, width = views.observed_ids.shape[-2:]
    return views.world_to_camera, views.intrinsics_at(height, width), (height, width)


if __name__ == "__main__":
    main()
