"""Draw the pictures of docs/concepts.md, from a room of `make-homes` and the prior `demo-bedroom`.

python docs/draw_concepts.py [--out docs/images/concepts]

The room is one of the prior's training rooms, so its masks and its latent belong together.
"""

import argparse
import io
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from PIL import Image

import sceneprior
from data_prep.engine.build import Job, build_shards
from data_prep.front.recipe import load_recipe
from data_prep.front.source import FrontSource
from data_prep.homes.make import make_homes
from data_prep.inspection.pictures import draw_view
from sceneprior.apps.viewer.map import make_map
from sceneprior.core.cameras import project
from sceneprior.core.classes import class_colors, label_set
from sceneprior.core.observations import RoomViews, thinned
from sceneprior.core.proxies import icosphere, place
from sceneprior.core.shards import Shard
from sceneprior.core.views import SceneViews
from sceneprior.paper.interpolate import interpolate
from sceneprior.paper.losses import soft_iou
from sceneprior.paper.matching import match_objects, matching_cost, seen_boxes
from sceneprior.paper.prior import LatentSphere, TrainedPrior
from sceneprior.paper.sampling import decode_latents, latent_of
from sceneprior.render.appearance import contact_sheet, paint_ids, png_bytes
from sceneprior.render.silhouettes import render_silhouettes
from sceneprior.render.topdown import corner_view, perspective

ROOM = "ec8d5242-490a-5e93-abcb-dabba44460e2_MasterBedroom-1031"
OTHER_ROOM = "64d75c66-85a5-5a21-babd-22c310a1ae1d_MasterBedroom-1175"
TILE = (180, 240)
OBSERVED = [22, 7, 2, 29]
"""Views of the room that are drawn."""
OF_THE_BED = [22, 2, 10, 12, 14, 17, 18, 30, 31, 33]
"""Views that show the bed with nothing but a nightstand in front of it; the first is drawn."""
MASK_STEP = 4  # masks are compared at 120 x 90, the paper's size
LAMBDA_B = 5.0  # of Eq. S2
STEPS, RATE_M = 60, 0.02
"""Number of steps and learning rate (metres) when the sphere's vertices are fitted."""
PULL = 20.0  # metres of arrow for a gradient of 1 / m


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("docs/images/concepts"))
    out = parser.parse_args().out
    out.mkdir(parents=True, exist_ok=True)
    prior = sceneprior.load("demo-bedroom").with_latents
    with training_room() as shard:
        room = shard.read_room(ROOM, images=True)
        draw_training_input(shard, out / "input.png")
    draw_latent_space(prior, out / "sphere.png")
    draw_generation(prior, out / "objects.png")
    draw_silhouettes(prior, views_of(room, OF_THE_BED), out / "silhouettes.png")
    draw_matching(prior, views_of(room, OBSERVED), out / "matching.png")
    draw_geodesic(prior, out / "geodesic.png")


@contextmanager
def training_room() -> Iterator[Shard]:
    """A shard that holds the room's views."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_homes(folder / "homes", 40, "bedroom", seed=0)  # enough to hold the room
        front, future = folder / "homes" / "3D-FRONT", folder / "homes" / "3D-FUTURE-model"
        source = FrontSource(front, future, load_recipe("bedroom"), only=ROOM)
        build_shards(Job(source, folder / "shards", renderer="software"))
        (path,) = (folder / "shards").glob("*/*.h5")
        with Shard(path) as shard:
            yield shard


def draw_training_input(shard: Shard, path: Path) -> None:
    """Masks and their 2D boxes, in the colours of their classes, and the floor's grid."""
    tiles = [np.asarray(draw_view(shard, ROOM, k, boxes_3d=False, width_px=300)) for k in OBSERVED]
    write(contact_sheet(tiles, 4, [f"camera {k + 1}" for k in range(len(tiles))], 4), path)


def draw_latent_space(prior: TrainedPrior, path: Path) -> None:
    """Anchors and training rooms on the map, one room's weights, and what it decodes to."""
    space = prior.prior.latent_space
    assert isinstance(space, LatentSphere)
    latent_map = make_map(space, space(prior.logits))
    row = prior.room_ids.index(ROOM)
    weights, anchors = prior.logits[row].softmax(dim=-1), latent_map.place(space.anchors)
    x, y = latent_map.rooms[row].tolist()
    figure, (left, right) = plt.subplots(1, 2, figsize=(8.8, 3.9), layout="constrained")
    for weight, (u, v) in zip(weights.tolist(), anchors.tolist(), strict=True):
        left.plot((x, u), (y, v), "tab:red", linewidth=25 * weight)
    left.scatter(*anchors.T, s=18, c="0.55", marker="^", label="anchors, fixed")
    left.scatter(*latent_map.rooms.T, s=12, c="tab:blue", label="training rooms")
    left.scatter(x, y, s=130, c="tab:red", marker="*", zorder=3, label="a room; lines: its weights")
    left.legend(fontsize=7)
    left.set(aspect="equal", xticks=[], yticks=[], title="two directions of the sphere")
    (room,) = decode_latents(prior, latent_of(prior, ROOM)[None], ["room"])
    right.imshow(perspective(room))
    right.set_title("what the room's point decodes to")
    right.axis("off")
    save(figure, path)


def draw_generation(prior: TrainedPrior, path: Path) -> None:
    """The room after one object, after two, and so on."""
    (room,) = decode_latents(prior, latent_of(prior, ROOM)[None], ["room"])
    view, tiles, captions = corner_view([room], TILE), [], []
    for k, item in enumerate(room.objects, start=1):
        tiles.append(perspective(replace(room, objects=room.objects[:k]), view=view))
        captions.append(f"{k}: {item.label.replace('_', ' ')}")
    write(contact_sheet(tiles, 4, captions, gap_px=4), path)


def draw_silhouettes(prior: TrainedPrior, views: SceneViews, path: Path) -> None:
    """A sphere in the bed's decoded box, before and after it is fitted to the bed's masks."""
    bed = label_set(prior.config.label_set).index("double_bed")
    item = int((views.object_class[0] == bed).nonzero())
    decoded = prior.prior.decode(latent_of(prior, ROOM)[None])
    k = int((decoded.class_logits[0].argmax(dim=-1) == bed).nonzero()[0])
    sphere, faces = icosphere(3)
    box = decoded.centers_m[:, k : k + 1].detach(), decoded.sizes_m[:, k : k + 1].detach()
    vertices = place(sphere[None, None], *box).requires_grad_()
    observed = (views.observed_ids[0] == item + 1).float()
    height, width = observed.shape[1:]
    intrinsics = views.mask_intrinsics()
    optimizer = torch.optim.Adam([vertices], lr=RATE_M)
    steps = []
    for _ in range(STEPS + 1):
        soft = render_silhouettes(
            vertices, faces, views.world_to_camera, intrinsics, (height, width),
            mode="fast", compositing="alone",
        )[0, :, 0]  # fmt: skip
        iou = soft_iou(soft, observed)
        (gradient,) = torch.autograd.grad(1 - iou[0], vertices, retain_graph=True)
        optimizer.zero_grad()
        (1 - iou).mean().backward()
        pulled = vertices.detach() - PULL * gradient
        steps.append((soft.detach()[0], iou.mean().item(), vertices.detach().clone(), pulled))
        optimizer.step()
    (first, before, *ends), (last, after, *_) = steps[0], steps[-1]
    here, there = (
        project(points, views.world_to_camera, intrinsics)[0, 0, 0, :, :2] for points in ends
    )
    figure, axes = plt.subplots(1, 4, figsize=(10.4, 2.4), layout="constrained")
    pictures = {
        "the bed's mask": observed[0],
        f"soft silhouette of a sphere, IoU {before:.2f}": first,
        "where this mask pulls its vertices": (observed[0] + first) / 4,
        f"after {STEPS} steps, IoU {after:.2f}": last,
    }
    for axis, (title, picture) in zip(axes, pictures.items(), strict=True):
        axis.imshow(picture, "gray_r", vmin=0, vmax=1)
        axis.set_title(title, fontsize=9)
        axis.set(xticks=[], yticks=[])
    moved = (there - here).norm(dim=1) > 1
    places, arrows = here[moved].T, (there - here)[moved].T
    axes[2].quiver(*places, *arrows, color="tab:red", angles="xy", scale_units="xy", scale=1)
    save(figure, path)


@torch.no_grad()
def draw_matching(prior: TrainedPrior, views: SceneViews, path: Path) -> None:
    """2D boxes of the predictions of a point 0.25 from the room's, over its masks; all costs."""
    names = label_set(prior.config.label_set)
    z = prior.prior.latent_space.step(latent_of(prior, ROOM)[None], length=0.25, seed=0)
    decoded = prior.prior.decode(z)
    boxes = seen_boxes(decoded, views, "beveled_box")
    matches = match_objects(decoded, boxes, views, LAMBDA_B)
    cost = matching_cost(decoded, boxes, views, LAMBDA_B)[0]
    labels, count = views.object_class[0].tolist(), len(views.object_class[0])
    colors = class_colors(len(names))[labels]
    size = torch.tensor(views.observed_ids.shape[-2:]).flip(0).repeat(2)
    figure, axes = plt.subplots(1, 3, figsize=(11.4, 3.2), layout="constrained")
    for view, axis in enumerate(axes[:2]):
        ids = views.observed_ids[0, view].numpy()
        axis.imshow(paint_ids(ids, (colors.astype(int) + 510) // 3, (255, 255, 255)))
        for item, k in enumerate(matches.prediction[0].tolist()):
            if not views.visible[0, view, item]:
                continue
            x1, y1, x2, y2 = (boxes.boxes[0, view, k] * size).tolist()
            color = colors[item] / 400
            bbox = {"facecolor": color, "edgecolor": "none", "pad": 1}
            axis.add_patch(plt.Rectangle((x1, y1), x2 - x1, y2 - y1, fill=False, color=color))
            axis.text(x1, y1, str(k + 1), color="white", fontsize=8, va="top", bbox=bbox)
        axis.set(xticks=[], yticks=[], title=f"camera {view + 1}")
    axes[2].imshow(cost[:count], "viridis_r")
    axes[2].plot(range(count), matches.prediction[0], "wo", mfc="none", ms=13, mew=2)
    axes[2].set_yticks(range(count), range(1, count + 1))
    axes[2].set_xticks(range(count), [names[label] for label in labels], rotation=40, ha="right")
    axes[2].set(ylabel="prediction", title="cost; circles: the cheapest assignment")
    save(figure, path)


def draw_geodesic(prior: TrainedPrior, path: Path) -> None:
    """Rooms at equal angles from the room to another training room."""
    rooms = interpolate(prior, ROOM, OTHER_ROOM, steps=5)
    view = corner_view(rooms, TILE)
    captions = [f"{room.extra['along']:.2f} of the way" for room in rooms]
    tiles = [perspective(room, view=view) for room in rooms]
    write(contact_sheet(tiles, 5, captions, gap_px=4), path)


def views_of(room: RoomViews, numbers: list[int]) -> SceneViews:
    """Some views of a room, as the losses read them."""
    assert room.instance_ids is not None, "read_room(images=True)"
    labels = torch.from_numpy(room.object_class).long()[None]
    names = ("world_to_camera", "intrinsics", "boxes", "visible", "sides_clear")
    return SceneViews(
        room_index=torch.tensor([0]),
        object_class=labels,
        is_object=torch.ones_like(labels, dtype=torch.bool),
        **{name: torch.from_numpy(getattr(room, name)[numbers])[None] for name in names},
        image_size=room.image_size,
        instance_ids=torch.from_numpy(room.instance_ids[numbers][:, *thinned(MASK_STEP)])[None],
    )


def save(figure: Figure, path: Path) -> None:
    """Write a figure as `write` writes pictures."""
    buffer = io.BytesIO()
    figure.savefig(buffer)
    write(np.asarray(Image.open(buffer).convert("RGB")), path)


def write(picture: np.ndarray, path: Path) -> None:
    """Write a picture as a PNG of 255 colours, a third of the size of full colour."""
    few = Image.fromarray(picture).quantize(255, dither=Image.Dither.NONE)
    path.write_bytes(png_bytes(few, optimize=True))


if __name__ == "__main__":
    main()
