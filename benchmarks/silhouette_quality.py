"""Quality of shapes by renderer mode and compositing: the shape stage, from one layout checkpoint.

    sceneprior fit --config paper/bedroom_small.yaml --run out/small     # once: for the layout
    python benchmarks/silhouette_quality.py --run out/small --epochs 10 --seed 0

Every variant starts from the same layout checkpoint and trains on the same batches. The decoded
training rooms are then rasterised without softness. Each object's visible mask is compared with the
observed mask (mask IoU, mean over objects and views), and its 3D box with the true box (mean over
objects).
"""

import argparse
import json
import shutil
import time
from pathlib import Path

import torch

from sceneprior.apps.config import load_config, load_run
from sceneprior.apps.experiments.evaluate import decoded_and_true
from sceneprior.core.cameras import boxes_of_points
from sceneprior.core.dataset import ViewDataset
from sceneprior.evaluation.metrics.contents import reconstruction_scores
from sceneprior.paper.matching import match_objects
from sceneprior.paper.prior import TrainedPrior
from sceneprior.render.silhouettes import render_scene
from sceneprior.training.fit import fit
from sceneprior.training.loader import make_loader

VARIANTS = ("exact/layered", "exact/paper", "fast/layered", "fast/paper")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--run", type=Path, default=Path("out/small"))
    parser.add_argument("--out", type=Path, default=Path("out/silhouette_quality"))
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--variants", nargs="+", default=VARIANTS)
    parser.add_argument("--set", nargs="*", default=(), help="other settings, as for `fit`")
    arguments = parser.parse_args()
    rows = {}
    for variant in arguments.variants:
        mode, compositing = variant.split("/")
        run = arguments.out / f"{mode}_{compositing}_{arguments.seed}"
        shutil.rmtree(run, ignore_errors=True)
        shutil.copytree(arguments.run / "layout", run / "layout")
        settings = (
            f"seed={arguments.seed}",
            f"shape.epochs={arguments.epochs}",
            f"shape.silhouettes={mode}",
            f"shape.compositing={compositing}",
            *arguments.set,
        )
        config = load_config(str(arguments.run / "config.yaml"), settings)
        start = time.perf_counter()
        fit(config, run, resume=False)
        seconds = time.perf_counter() - start
        trained = load_run(run)
        truth = reconstruction_scores(decoded_and_true(trained, Path(config.data.shards)))
        rows[variant] = {
            "mask_iou": mask_iou(trained),
            "box_iou_3d": truth["box_iou_3d"],
            "class_accuracy": truth["class_accuracy"],
            "seconds": seconds,
        }
        figures = "  ".join(f"{name} {value:.4f}" for name, value in rows[variant].items())
        print(f"{variant:16s} {figures}", flush=True)
    (arguments.out / f"figures_{arguments.seed}.json").write_text(json.dumps(rows, indent=2))


@torch.no_grad()
def mask_iou(trained: TrainedPrior) -> float:
    """Mean IoU of visible hard masks over objects and views of all training rooms."""
    data = trained.config.data
    dataset = ViewDataset(
        Path(data.shards), "train", views_per_room=8, mask_step=data.mask_step, seed=0
    )
    total = count = 0.0
    for views in make_loader(dataset, 16, seed=0, workers=0):
        scenes = trained.prior.decode(trained.prior.latent_space(trained.logits[views.room_index]))
        assert scenes.vertices_m is not None and trained.prior.faces is not None, "of meshes"
        boxes = boxes_of_points(
            scenes.vertices_m, views.world_to_camera, views.intrinsics, views.image_size
        )
        matches = match_objects(scenes, boxes, views)
        ids = views.observed_ids
        height, width = ids.shape[-2:]
        drawn = torch.arange(scenes.centers_m.shape[1]) < views.is_object.sum(-1, keepdim=True)
        front = render_scene(
            scenes.vertices_m,
            trained.prior.faces,
            views.world_to_camera,
            views.intrinsics_at(height, width),
            (height, width),
            drawn=drawn,
        ).front
        room, view, item = (views.visible & matches.valid.unsqueeze(1)).nonzero(as_tuple=True)
        mine = front[room, view] == matches.prediction[room, item][:, None, None]
        seen = ids[room, view] == (item + 1)[:, None, None]
        both, either = (mine & seen).sum(dim=(1, 2)), (mine | seen).sum(dim=(1, 2))
        total += float((both / either.clamp(min=1)).sum())
        count += len(room)
    return total / count


if __name__ == "__main__":
    main()
