"""The part `sphere` of `gpu.py`: does the paper's sphere hold more rooms if it is given more?

The released network is trained on all rooms of a file of views and on 534 of them, at the same
time, as two processes; the layout stage alone, for as long as the part may take. Each process
writes training rooms, rooms decoded from N(0, 1), and rooms half-way between two training rooms to
FOLDER/sphere_ROOMS.npz. The file of views is made of shards before, and the rooms are compared with
those of the shards after, on a CPU:

    python benchmarks/gpu_sphere.py views SHARDS FLAT.npz
    python benchmarks/gpu_sphere.py train FLAT.npz FOLDER ROOMS cuda --seconds 480   # one training
    python benchmarks/gpu_sphere.py evaluate SHARDS FOLDER/sphere_*.npz

The released network is that of configs/paper/released.yaml. Read the result only where training
rooms are decoded (a class loss below 0.05).
"""

import argparse
import json
import math
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from sceneprior.apps.config import load_config
from sceneprior.core.classes import label_set
from sceneprior.core.dataset import FlatViews, ViewDataset
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.core.settings import find_config
from sceneprior.core.views import SceneViews
from sceneprior.paper.losses import kept_objects
from sceneprior.paper.prior import ScenePrior
from sceneprior.paper.static_step import StaticStep
from sceneprior.training.graphs import OnHost
from sceneprior.training.steps import weighted_sum

if TYPE_CHECKING:
    from gpu_parts import Setup

LABELS = "front3d_bedroom"
FEW_ROOMS = 534
VIEWS_KEPT, VIEWS, BATCH, SHOWN_S = 24, 20, 128, 12.0
AROUND_S = 20.0
"""Seconds before and after a training, for imports and for writing rooms."""
RATE, LATENT_RATE, CLIP = 3e-4, 1e-4, 1.0
DECODED = ("any", "between", "train")
"""Rooms from N(0, 1), half-way between two training rooms, and training rooms."""
SMALL = ("model.width=32", "model.decoder.hidden=32", "model.decoder.heads=2")
"""Changes for a trial on a CPU."""


def sphere(setup: "Setup") -> None:
    """Train on all rooms and on some of them, side by side."""
    if setup.flat is None:
        setup.note("not measured: name a file of views with --flat", {})
        return
    began = time.perf_counter()
    with np.load(setup.flat) as data:
        rooms = len(data["object_count"])
    until = setup.until - AROUND_S
    if setup.device == "cpu":
        until = min(until, time.time() + 60)
    children = {}
    for count in (rooms, min(FEW_ROOMS, rooms // 2)):
        words = [str(setup.flat), str(setup.folder), str(count), setup.device]
        words += ["--seconds", f"{until - time.time():.1f}"]
        command = [sys.executable, "-u", __file__, "train", *words]
        children[count] = subprocess.Popen(command)
    for count, child in children.items():
        status = child.wait()
        told = setup.folder / f"sphere_{count}.json"
        if status or not told.is_file():
            setup.note(f"{count:,} rooms: failed with status {status}; see the output above", {})
            continue
        setup.note(f"{count:,} rooms", json.loads(told.read_text()))
    print(f"sphere: {time.perf_counter() - began:.0f} s", flush=True)


class Rooms:
    """The views of some rooms on a device, drawn in batches of one shape."""

    def __init__(self, path: Path, count: int, slots: int, device: str, seed: int):
        with np.load(path) as data:
            arrays = {name: torch.from_numpy(data[name]) for name in data.files}
        self.views, self.slots, self.device = int(arrays.pop("views")), slots, device
        height, width = arrays.pop("size").tolist()
        self.image_size = (int(height), int(width))
        for name in ("boxes", "intrinsics", "world_to_camera"):
            arrays[name] = arrays[name].float()
        flat = FlatViews(**{field.name: arrays[field.name] for field in fields(FlatViews)})
        every = len(flat.object_count)
        self.used = np.sort(np.random.default_rng([seed, 5]).permutation(every)[:count])
        self.counts = flat.object_count.numpy()[self.used]
        self.classes = [
            flat.object_class[first : first + many].numpy()
            for first, many in zip(flat.first_object[self.used], self.counts, strict=True)
        ]
        self.flat = flat.to(device)
        self.number = torch.from_numpy(self.used).to(device)

    def batch(self, rows: np.ndarray) -> SceneViews:
        """Views of these rows, with the numbers of objects, which the host knows."""
        flat, row = self.flat, torch.from_numpy(rows)
        if self.device == "cuda":
            row = row.pin_memory()
        row = row.to(self.device, non_blocking=True)
        room = self.number[row]
        view = torch.rand(len(rows), self.views, device=self.device).argsort(dim=1)[:, :VIEWS]
        slot = torch.arange(self.slots, device=self.device)
        count = flat.object_count[room][:, None]
        is_object = slot < count
        at_object = flat.first_object[room][:, None] + slot
        at_object = at_object.where(is_object, len(flat.object_class) - 1)
        at_sighting = (flat.first_sighting[room][:, None] + view * count)[:, :, None] + slot
        at_sighting = at_sighting.where(is_object[:, None], len(flat.visible) - 1)
        at_view = flat.first_view[room][:, None] + view
        views = SceneViews(
            room_index=row,
            object_class=flat.object_class[at_object].long() * is_object,
            is_object=is_object,
            world_to_camera=flat.world_to_camera[at_view],
            intrinsics=flat.intrinsics[at_view],
            boxes=flat.boxes[at_sighting],
            visible=flat.visible[at_sighting] & is_object[:, None],
            sides_clear=flat.sides_clear[at_sighting],
            image_size=self.image_size,
        )
        views.__dict__["object_counts"] = self.counts[rows].tolist()
        return views


def write_views(shards: Path, out: Path) -> None:
    """Write views of the training rooms, as many of each room; rooms with fewer repeat some."""
    data = ViewDataset(shards, "train", VIEWS)
    arrays = {field.name: getattr(data.flat, field.name).numpy() for field in fields(FlatViews)}
    rng, views, sightings = np.random.default_rng(0), [], []
    objects, last = arrays["object_count"], len(arrays["visible"]) - 1
    ends = [*arrays["first_view"][1:], len(arrays["world_to_camera"])]
    for room, (first, end) in enumerate(zip(arrays["first_view"], ends, strict=True)):
        order = np.concatenate([rng.permutation(end - first) for _ in range(VIEWS_KEPT)])
        kept = np.sort(order[:VIEWS_KEPT])
        views.append(first + kept)
        slots = np.arange(objects[room])
        at = arrays["first_sighting"][room] + kept[:, None] * len(slots) + slots
        sightings.append(at.ravel())
    of_view, of_sighting = np.concatenate(views), np.concatenate([*sightings, [last]])
    arrays |= {name: arrays[name][of_view] for name in ("world_to_camera", "intrinsics")}
    arrays |= {name: arrays[name][of_sighting] for name in ("boxes", "visible", "sides_clear")}
    arrays["first_view"] = np.arange(len(objects)) * VIEWS_KEPT
    arrays["first_sighting"] = np.cumsum(objects * VIEWS_KEPT) - objects * VIEWS_KEPT
    np.savez_compressed(out, **arrays, views=VIEWS_KEPT, size=np.array(data._image_sizes[0]))


def train(path: Path, out: Path, count: int, device: str, seconds: float, seed: int = 0) -> None:
    """Train for a time, then write decoded rooms and figures."""
    until = time.time() + seconds
    small = SMALL if device == "cpu" else ()
    batch = 16 if small else BATCH
    torch.set_float32_matmul_precision("high")
    torch.set_num_threads(1)
    changes = (f"label_set={LABELS}", f"layout.batch_size={batch}", *small)
    config: Any = load_config(str(find_config("paper/released.yaml")), changes)
    rooms = Rooms(path, count, config.model.max_objects, device, seed)
    config = config.model_copy(update={"seed": seed})
    prior = config.build_prior().to(device).train()
    prior.shape.requires_grad_(False)
    prior.bevels.requires_grad_(False)
    latents = nn.Embedding(count, config.model.logits_per_room).to(device)
    static = StaticStep(prior, config.layout, config.loss, config.model.completeness_target)
    network = [weight for weight in prior.parameters() if weight.requires_grad]
    groups = [
        {"params": network, "lr": RATE}, {"params": [*latents.parameters()], "lr": LATENT_RATE},
    ]  # fmt: skip
    adam = torch.optim.Adam(groups, fused=device != "cpu")
    rng = np.random.default_rng(seed)
    order, at, step, history = rng.permutation(count), 0, 0, []
    summed, since, shown = None, 0, time.perf_counter()
    names = ("class", "box", "completeness", "frustum")
    began, seconds = time.perf_counter(), max(until - time.time(), 5.0)
    while (done := (time.perf_counter() - began) / seconds) < 1:
        warm = min(1.0, done / 0.05)
        fall = 0.5 * (1 + math.cos(math.pi * max(0.0, done - 0.05) / 0.95))
        for group, rate in zip(adam.param_groups, (RATE, LATENT_RATE), strict=True):
            group["lr"] = rate * min(warm, fall)
        if at + batch > count:
            order, at = rng.permutation(count), 0
        views = rooms.batch(order[at : at + batch])
        at += batch
        z = prior.latent_space(latents(views.room_index))
        static.prepare(z, views)
        scenes, _ = static.layouts(z)
        boxes = static.boxes(scenes, views)
        matches = static.matches(static.cost(scenes, boxes, views), views)
        losses = static.losses(scenes, boxes, views, matches)
        total = weighted_sum(losses, config.loss)
        adam.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(network, CLIP, foreach=device != "cpu")
        adam.step()
        values = torch.stack([losses[name].detach() for name in names])
        summed = values if summed is None else summed + values
        step, since = step + 1, since + 1
        if time.perf_counter() - shown > min(SHOWN_S, seconds / 4):
            means = (summed / since).tolist()
            spread = float(latents.weight.detach().std())
            ms = 1e3 * (time.perf_counter() - shown) / since
            history.append([step, time.perf_counter() - began, *means])
            said = ", ".join(f"{n} {v:.4f}" for n, v in zip(names, means, strict=True))
            where = f"{count} rooms, step {step}, {ms:.1f} ms, epoch {step * batch / count:.0f}"
            print(f"{where}: {said}, std {spread:.2f}", flush=True)
            if not all(map(math.isfinite, means)):
                raise FloatingPointError(f"the loss is no number in step {step}")
            summed, since, shown = None, 0, time.perf_counter()
    OnHost(latents.weight).read()  # the device has ended
    figures = {
        "steps": step, "epochs": step * batch / count,
        "step_ms": 1e3 * (time.perf_counter() - began) / max(step, 1),
    }  # fmt: skip
    if history:
        figures |= dict(zip((f"{name}_loss" for name in names), history[-1][2:], strict=True))
    figures |= write_rooms(prior, latents.weight.detach(), rooms, out, history)
    (out / f"sphere_{count}.json").write_text(json.dumps(figures))


@torch.no_grad()
def write_rooms(
    prior: ScenePrior, logits: Tensor, rooms: Rooms, out: Path, history: list[list[float]]
) -> dict[str, float]:
    """Write 1,000 rooms from N(0, 1) and up to 1,000 decoded training rooms; returns figures."""
    prior.eval()
    count = len(logits)
    generator = torch.Generator().manual_seed(7)
    drawn = torch.randn(1000, logits.shape[1], generator=generator).to(logits.device)
    pick = torch.randperm(count, generator=generator)[:1000]
    known, anywhere = prior.latent_space(logits), prior.latent_space(drawn)
    trained = known[pick.to(logits.device)]
    between = nn.functional.normalize(trained + trained.roll(1, dims=0), dim=1)
    between = between * trained.norm(dim=1, keepdim=True)
    found: dict[str, Any] = {"pick": rooms.used[pick.numpy()], "history": np.array(history)}
    for name, z in zip(DECODED, (anywhere, between, trained), strict=True):
        parts = [prior.layouts(some, prior.max_objects)[0] for some in z.split(128)]
        logits_of = torch.cat([part.class_logits for part in parts])
        stop = torch.cat([part.completeness_logits for part in parts])
        found[f"{name}_class"] = logits_of.argmax(-1).cpu().numpy().astype(np.int16)
        found[f"{name}_kept"] = kept_objects(stop, "stop").cpu().numpy()
        found[f"{name}_centers"] = torch.cat([part.centers_m for part in parts]).cpu().numpy()
        found[f"{name}_sizes"] = torch.cat([part.sizes_m for part in parts]).cpu().numpy()
    np.savez_compressed(out / f"sphere_{count}.npz", **found)
    counted = [np.bincount(found[f"{name}_class"][found[f"{name}_kept"]], minlength=64) for name in
               ("any", "train")]  # fmt: skip
    real = np.bincount(np.concatenate(rooms.classes), minlength=64)
    same = [
        sorted(found["train_class"][k][found["train_kept"][k]].tolist())
        == sorted(rooms.classes[row].tolist())
        for k, row in enumerate(pick.tolist())
    ]
    near = (trained @ known.T).topk(2, dim=1).values[:, 1]
    return {
        "latent_std": float(logits.std()),
        "nearest_cosine_any": float((anywhere @ known.T).amax(dim=1).mean()),
        "nearest_cosine_train": float(near.mean()),
        "kl_any": _kl(real, counted[0]), "kl_train": _kl(real, counted[1]),
        "objects_any": float(found["any_kept"].sum() / len(anywhere)),
        "train_rooms_with_their_classes": float(np.mean(same)),
    }  # fmt: skip


def _kl(real: np.ndarray, found: np.ndarray) -> float:
    p, q = real / real.sum(), found / max(found.sum(), 1)
    return float((p * (np.log(p + 1e-6) - np.log(q + 1e-6))).sum())


def evaluate(shards: Path, files: Sequence[Path]) -> None:
    """Compare decoded rooms with those of shards: layout classifier, gaps and category KL."""
    from sceneprior.core.ground_truth import independent_rooms, reference_scenes, shuffled_rooms

    splits = ("train", "val", "test")
    real = {split: reference_scenes(shards, split, meshes=False) for split in splits}
    print({split: len(scenes) for split, scenes in real.items()}, flush=True)
    train = real["train"]
    few = min(1000, len(train))
    sets = {
        "real training rooms": train, "shuffled": shuffled_rooms(train, few, 1),
        "independent": independent_rooms(train, few, 1),
    }  # fmt: skip
    for file in files:
        with np.load(file) as data:
            sets |= {f"{file.stem}, {n}": decoded_rooms(data, n) for n in DECODED}
    for name, scenes in sets.items():
        print(name, scores(scenes, real), flush=True)


def scores(scenes: Sequence[Scene], real: dict[str, list[Scene]]) -> str:
    """The three scores of a set of rooms as text."""
    from sceneprior.evaluation.metric import Comparison, RoomSet, resample_counts
    from sceneprior.evaluation.metrics import contents, layouts

    rooms, test = (RoomSet(s, {}, resample_counts(len(s), 0, 0)) for s in (scenes, real["test"]))
    pairs = np.zeros((len(label_set(LABELS)),) * 2, bool)
    against = Comparison(test, real["train"], real["val"], [], 0, None, pairs, 0.0)
    values = {
        "layout classifier": layouts.layout_classifier_accuracy(rooms, against).value,
        "gaps_m": layouts.relation_distance(rooms, against).value,
        "category_kl": contents._category_kl(rooms, against).value,
        "objects": sum(len(scene.objects) for scene in scenes) / len(scenes),
    }
    return ", ".join(f"{key} {value:.3f}" for key, value in values.items() if value is not None)


def decoded_rooms(data: Any, name: str) -> list[Scene]:
    """The scenes of one set of rooms in a file of `write_rooms`, without void."""
    names = label_set(LABELS)
    kept, classes = data[f"{name}_kept"], data[f"{name}_class"]
    centers, sizes = data[f"{name}_centers"], data[f"{name}_sizes"]
    return [
        Scene(
            f"{name}_{room}",
            LABELS,
            tuple(
                SceneObject(names[classes[room, k]], tuple(centers[room, k]), tuple(sizes[room, k]))
                for k in np.flatnonzero(kept[room] & (classes[room] > 0))
            ),
        )
        for room in range(len(kept))
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parts = parser.add_subparsers(dest="part", required=True)
    viewed, trained, evaluated = map(parts.add_parser, ("views", "train", "evaluate"))
    viewed.add_argument("shards", type=Path)
    viewed.add_argument("flat", type=Path)
    for name, kind in (("flat", Path), ("out", Path), ("rooms", int)):
        trained.add_argument(name, type=kind)
    trained.add_argument("device", choices=("cuda", "cpu"))
    trained.add_argument("--seconds", type=float, default=480.0)
    trained.add_argument("--seed", type=int, default=0)
    evaluated.add_argument("shards", type=Path)
    evaluated.add_argument("files", nargs="+", type=Path)
    o = parser.parse_args()
    if o.part == "views":
        write_views(o.shards, o.flat)
    elif o.part == "train":
        train(o.flat, o.out, o.rooms, o.device, o.seconds, o.seed)
    else:
        evaluate(o.shards, o.files)


if __name__ == "__main__":
    main()
