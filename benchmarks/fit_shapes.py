"""Shapes from masks without a network: fitted meshes by renderer mode, and lifted shapes.

    sceneprior make-homes out/fit/homes --rooms 48 --room-type bedroom --seed 0
    sceneprior prep-front --front out/fit/homes/3D-FRONT --future out/fit/homes/3D-FUTURE-model \
        --recipe bedroom --out out/fit/shards
    python benchmarks/fit_shapes.py --shards out/fit/shards --rooms 24 --steps 150 --seed 0

Two fifths of the views of each room are fitted, the others are held out. A mesh starts as a sphere
in its object's true box, moved by about 15 cm and scaled by about a quarter. Its vertices and box
are optimised by the mask loss alone (masks at 120 x 90, the paper's sigma). All variants take the
same steps on the same views from the same start. `lifted` uses neither true boxes nor steps: boxes
and parts are found from full-size masks, as in `fit`. The scores are the IoU of each object's
visible hard mask in held-out views, and the IoU of the mesh's bounding box with the true one. With
--image-step k, every k-th pixel of the masks is used along each axis.
"""

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from sceneprior.core.dataset import ViewDataset
from sceneprior.core.meshes import icosphere, place
from sceneprior.core.overlaps import box_iou_3d
from sceneprior.core.scene import Mesh
from sceneprior.core.shards import iterate_rooms
from sceneprior.core.views import SceneViews
from sceneprior.lifted.lifting.dataset import LiftedDataset
from sceneprior.lifted.lifting.hulls import ShapeGrid
from sceneprior.lifted.prototype_decoder import PrototypeConfig
from sceneprior.paper.losses import mask_loss
from sceneprior.paper.matching import Matches
from sceneprior.render.offscreen.renderer import Pinhole, SoftwareRenderer
from sceneprior.render.silhouettes import render_silhouettes

LIFTED = "lifted"
VARIANTS = (LIFTED, "exact/layered", "exact/paper", "fast/layered", "fast/paper")
BATCH = 8
VIEWS, FITTED = 8, 0.4
GRID = ShapeGrid(cells=32, margin=1.1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shards", type=Path, default=Path("out/demo/shards"))
    parser.add_argument("--rooms", type=int, default=24)
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--level", type=int, default=2, help="level of the icosphere")
    parser.add_argument("--image-step", type=int, default=4)
    parser.add_argument("--variants", nargs="+", default=VARIANTS)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    shards, count = arguments.shards, arguments.rooms
    fitted, judged = (
        ViewDataset(
            shards, "train", VIEWS, mask_step=arguments.image_step, seed=arguments.seed,
            view_fraction=FITTED, held_out=held_out,
        )
        for held_out in (False, True)
    )  # fmt: skip
    truths = [shard.read_ground_truth(room) for shard, room in iterate_rooms(shards, "train")]
    figures = {}
    for variant in arguments.variants:
        start = time.process_time()
        if variant == LIFTED:
            meshes = lift_rooms(shards, arguments.seed)
        else:
            mode, compositing = variant.split("/")
            meshes = []
            for first in range(0, count, BATCH):
                rows = list(range(first, min(first + BATCH, count)))
                meshes += fit_rooms(fitted, truths, rows, mode, compositing, arguments)
        seconds = time.process_time() - start
        results = [judge(meshes[row], judged, row, truths[row]) for row in range(count)]
        masks, boxes = (np.concatenate(values) for values in zip(*results, strict=True))
        figures[variant] = {
            "mask_iou": float(masks.mean()),
            "box_iou_3d": float(boxes.mean()),
            "objects": len(boxes),
            "cpu_seconds_a_room": seconds / len(meshes),
        }
        print(variant, "  ".join(f"{k} {v:.4g}" for k, v in figures[variant].items()), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(figures, indent=2) + "\n")


def lift_rooms(shards: Path, seed: int) -> list[list[Mesh]]:
    """Lifted meshes of all rooms' objects; empty for an object that no view shows."""
    with tempfile.TemporaryDirectory() as name:  # the cache next to the shards uses all views
        for each in shards.iterdir():
            if not each.name.startswith("lifted_"):
                (Path(name) / each.name).symlink_to(each.resolve())
        lifted = LiftedDataset(Path(name), "train", view_fraction=FITTED, shape=GRID, seed=seed)
    prototypes = lifted.find_prototypes(1024)
    shapes = PrototypeConfig(prototypes=1024, cells=GRID.cells, margin=GRID.margin).build(1)
    shapes.set_prototypes(prototypes)
    looks = iter(lifted.posed_prototypes(prototypes).tolist())
    rooms = []
    for room in lifted.boxes:
        found = []
        for center, size, look in zip(room.centers_m, room.sizes_m, looks, strict=False):
            box_m = np.concatenate([center, size])
            found.append(shapes.mesh(look, box_m) if look >= 0 else NOTHING)
        rooms.append(found)
    return rooms


NOTHING = Mesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64))


def fit_rooms(dataset, truths, rows, mode, compositing, arguments) -> list[list[Mesh]]:
    """Meshes of some rooms' objects, fitted to their masks."""
    views = dataset.__getitems__([(row, 0) for row in rows])
    counts = views.is_object.sum(dim=1).tolist()
    centers, sizes = torch.zeros(2, len(rows), max(counts), 3)
    for slot, (row, count) in enumerate(zip(rows, counts, strict=True)):
        centers[slot, :count] = torch.from_numpy(truths[row].centers_m[:count])
        sizes[slot, :count] = torch.from_numpy(truths[row].sizes_m[:count])
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
    found = vertices().detach().numpy()
    return [
        [Mesh(found[slot, item], faces.numpy()) for item in range(count)]
        for slot, count in enumerate(counts)
    ]


def judge(meshes: Sequence[Mesh], judged, row, truth) -> tuple[np.ndarray, np.ndarray]:
    """Mask IoUs of a room in held-out views, one per (object, view), and its box IoUs."""
    views = judged.__getitems__([(row, 0)])
    poses, intrinsics, image_size = cameras(views)
    ids = SoftwareRenderer().instance_ids_of_views(
        meshes,
        [
            Pinhole(pose.double().numpy(), intrinsic.double().numpy())
            for pose, intrinsic in zip(poses[0], intrinsics[0], strict=True)
        ],
        image_size,
    )
    view, item = views.visible[0].nonzero(as_tuple=True)
    mine = torch.from_numpy(ids.astype(np.int64))[view] == item[:, None, None] + 1
    seen = views.instance_ids[0, view] == (item + 1)[:, None, None]
    both, either = (mine & seen).sum(dim=(1, 2)), (mine | seen).sum(dim=(1, 2))
    corners = [mesh.vertices_m if len(mesh.faces) else np.zeros((1, 3)) for mesh in meshes]
    low_m, high_m = (np.array([f(each, axis=0) for each in corners]) for f in (np.min, np.max))
    centers_m, sizes_m = (part[: len(meshes)] for part in (truth.centers_m, truth.sizes_m))
    box_iou = box_iou_3d((low_m + high_m) / 2, high_m - low_m, centers_m, sizes_m).diagonal()
    return (both / either.clamp(min=1)).numpy(), box_iou


def cameras(views: SceneViews) -> tuple[torch.Tensor, torch.Tensor, tuple[int, int]]:
    """Poses, intrinsics and size of the views' mask images."""
    height, width = views.observed_ids.shape[-2:]
    return views.world_to_camera, views.intrinsics_at(height, width), (height, width)


if __name__ == "__main__":
    main()
