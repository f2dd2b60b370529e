"""Robustness to noise: scores after training on clean and on corrupted masks and poses.

Run `python benchmarks/robustness.py --shards DIR [--seeds 0 1]`. The observations of the training
split are corrupted in memory, by the same noise in every row of a seed; the 3D ground truth of the
scores stays unchanged. Each row trains only the layout stage, from the same initialisation and for
the same number of steps, on rooms of at most four objects, for which steps are fast.
"""

import argparse
import logging
import time
import warnings
from dataclasses import replace
from pathlib import Path

import lightning
import torch
from torch import Tensor
from torch.utils.data import Dataset

from sceneprior.apps.config import load_config
from sceneprior.core.dataset import FlatViews, ViewDataset
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.views import SceneViews
from sceneprior.evaluation.metrics.contents import reconstruction_scores
from sceneprior.paper.config import PaperConfig
from sceneprior.paper.decode import decode_training_rooms
from sceneprior.paper.prior import TrainedPrior
from sceneprior.paper.stages import LayoutStage
from sceneprior.training.loader import make_loader

BASE = Path(__file__).parents[1] / "configs" / "paper/bedroom_small.yaml"
SETTINGS = (
    "data.views_per_room=12",
    "model.max_objects=4",
    "model.width=64",
    "model.decoder.hidden=64",
    "layout.batch_size=48",
    "layout.learning_rate=3e-3",
    "layout.latent_noise=0.04",
)
WRONG = 0.2
"""Share of observations with a wrong mask; an equal share is dropped."""
DEGREES, METRES = 2.0, 0.05
"""Root mean square rotation and translation of the noise on cameras."""


def spoil_masks(flat: FlatViews, seed: int) -> FlatViews:
    """Jitter all 2D boxes by 1% of the image, corrupt a share `WRONG` of them, and drop as many.

    A third of the corrupted boxes are moved by up to a quarter of the image, a third lose half
    their width or height, like fragmented masks, and a third take the box of the next observation,
    like swapped ids.
    """
    generator = torch.Generator().manual_seed(seed)
    count = len(flat.boxes)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    boxes = flat.boxes + 0.01 * torch.randn(count, 4, generator=generator)
    fate = uniform(count)
    moved = boxes + (uniform(count, 2) - 0.5).mul(0.5).repeat(1, 2)
    lower, upright = uniform(count) < 0.5, uniform(count) < 0.5
    row, side = torch.arange(count), upright.logical_not().long()
    middle = (boxes[:, :2] + boxes[:, 2:]) / 2
    cut = boxes.clone()
    cut[row, side + 2 * (~lower).long()] = middle[row, side]
    beside = row.roll(-1)
    swapped = torch.where(flat.visible[beside, None], boxes[beside], boxes)
    for third, wrong in enumerate((moved, cut, swapped)):
        chosen = (fate >= third * WRONG / 3) & (fate < (third + 1) * WRONG / 3)
        boxes = torch.where(chosen[:, None], wrong, boxes)
    lost = (fate >= WRONG) & (fate < 2 * WRONG)
    return replace(flat, boxes=boxes.clamp(0, 1), visible=flat.visible & ~lost)


def spoil_poses(flat: FlatViews, seed: int) -> FlatViews:
    """Rotate each camera about a random axis and translate it, by normally distributed amounts."""
    generator = torch.Generator().manual_seed(seed)
    count = len(flat.world_to_camera)
    turn = torch.randn(count, 3, generator=generator) * (DEGREES * torch.pi / 180 / 3**0.5)
    x, y, z = turn.unbind(1)
    zero = torch.zeros_like(x)
    skew = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    motion = torch.eye(4).repeat(count, 1, 1)
    motion[:, :3, :3] = torch.linalg.matrix_exp(skew)
    motion[:, :3, 3] = torch.randn(count, 3, generator=generator) * (METRES / 3**0.5)
    return replace(flat, world_to_camera=motion @ flat.world_to_camera)


class SmallRooms(Dataset):
    """The first `count` training rooms with at most `objects` objects."""

    masks = None

    def __init__(self, views: ViewDataset, count: int, objects: int):
        self.views = views
        self.rows = (views.flat.object_count <= objects).nonzero()[:count, 0].tolist()
        self.room_ids = tuple(views.room_ids[row] for row in self.rows)

    def __len__(self) -> int:
        return len(self.rows)

    def __getitems__(self, draws: list[tuple[int, int]]) -> SceneViews:
        batch = self.views.__getitems__([(self.rows[row], epoch) for row, epoch in draws])
        return replace(batch, room_index=torch.tensor([row for row, _ in draws]))


def train(config: PaperConfig, rooms: SmallRooms) -> TrainedPrior:
    """Train the layout stage alone, on observations in memory."""
    assert config.layout is not None, "BASE has a layout stage"
    lightning.seed_everything(config.seed, verbose=False)
    prior, latents = config.build_prior(), config.build_latents(len(rooms))
    trainer = lightning.Trainer(
        max_epochs=config.layout.epochs, logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, accelerator="cpu",
        gradient_clip_val=config.layout.clip_gradient or None,
    )  # fmt: skip
    loader = make_loader(rooms, config.layout.batch_size, config.seed, 0)  # type: ignore[arg-type]
    stage = LayoutStage(
        prior, latents, rooms, config.layout, config.loss, config.model.completeness_target,
        config.seed,
    )  # fmt: skip
    trainer.fit(stage, loader)
    prior = prior.eval().requires_grad_(False)
    return TrainedPrior(prior, latents.weight.detach(), rooms.room_ids, config, "layout")


def row(name: str, config: PaperConfig, rooms: int, masks: bool, poses: bool) -> None:
    """Train on some rooms, corrupted or not, and print the scores of their reconstruction."""
    folder = Path(config.data.shards)
    data = ViewDataset(folder, "train", config.data.views_per_room, seed=config.seed)
    if masks:
        data.flat = spoil_masks(data.flat, config.seed + 10)
    if poses:
        data.flat = spoil_poses(data.flat, config.seed + 11)
    chosen = SmallRooms(data, rooms, config.model.max_objects)
    start = time.process_time()
    trained = train(config, chosen)
    seconds = time.process_time() - start
    known = reference_scenes(folder, "train", max(chosen.rows) + 1, tracked_only=True)
    truth = [known[index] for index in chosen.rows]
    scores = reconstruction_scores(list(zip(decode_training_rooms(trained), truth, strict=True)))
    print(
        f"| {name} | {config.seed} | {scores['box_iou_3d']:.3f} | {scores['class_accuracy']:.3f} "
        f"| {seconds:.0f} |",
        flush=True,
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--shards", type=Path, required=True)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--epochs", type=int, default=1000)
    parser.add_argument("--rooms", type=int, default=48)
    options = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    print("| observations | seed | box IoU 3D | class accuracy | CPU seconds |")
    print("| --- | --- | --- | --- | --- |")
    for seed in options.seeds:
        for said, masks, poses in (
            ("masks and poses spoilt", True, True),
            ("masks spoilt", True, False),
            ("clean", False, False),
        ):
            changes = (
                f"data.shards={options.shards}", f"layout.epochs={options.epochs}", f"seed={seed}"
            )  # fmt: skip
            config = load_config(str(BASE), SETTINGS + changes).with_label_set()
            assert isinstance(config, PaperConfig)
            row(said, config, options.rooms, masks, poses)
