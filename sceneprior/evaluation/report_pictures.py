"""Pictures of the report page, as data URIs: rooms, input views and learning curves."""

import io
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sceneprior.core.classes import label_set
from sceneprior.core.scene import Scene
from sceneprior.core.shards import Shard, iterate_rooms
from sceneprior.core.shell import ShellName
from sceneprior.evaluation.page import data_uri, glb_of, png_uri
from sceneprior.render.appearance import quiet_colors
from sceneprior.render.floor_plans import plan_of
from sceneprior.render.pictures import paint_ids
from sceneprior.render.topdown import perspective, topdown_protocol, view_of

_POINTS_PER_CURVE = 400
_EMPTY = (244, 245, 247)


@dataclass(frozen=True)
class RoomPictures:
    """The pictures and the 3D model of one scene on the page."""

    name: str
    contents: str
    """The scene's objects in words: "double bed, nightstand ×2"."""
    topdown: str
    """Data URI of the plan from straight above, at half size and the same scale for all rooms."""
    perspective: str
    """Data URI of the shaded view from above a corner."""
    glb: str
    """Data URI of the 3D model that replaces the shaded view; empty if none was requested."""


def room_pictures(scene: Scene, most_faces: int = 0, shell: ShellName = "none") -> RoomPictures:
    """Draw a scene's plan and corner view, and export its 3D model.

    View and model have walls if `shell` is `walls`, or the room has doors or windows. `most_faces`
    limits the faces of each object's mesh; 0 leaves the model out.
    """
    counts = Counter(item.label.replace("_", " ") for item in scene.objects)
    words = [name if many == 1 else f"{name} ×{many}" for name, many in sorted(counts.items())]
    flat = plan_of(scene, np.zeros(2), topdown_protocol(scene.label_set).window_m)
    flat = flat.resize((256, 256), Image.Resampling.BOX)
    solid = io.BytesIO()
    shaded = Image.fromarray(perspective(scene, view=view_of(scene, (330, 440), shell)))
    shaded.save(solid, format="JPEG", quality=86, optimize=True)
    solid_uri = data_uri("image/jpeg", solid.getvalue())
    glb = data_uri("model/gltf-binary", glb_of(scene, most_faces, shell)) if most_faces else ""
    contents = ", ".join(words) or "nothing"
    return RoomPictures(scene.name, contents, png_uri(flat.quantize(64)), solid_uri, glb)


def legend(scenes: Sequence[Scene]) -> list[tuple[str, str]]:
    """(class name, CSS colour) of every class in the scenes, in the label set's order."""
    if not scenes:
        return []
    names = label_set(scenes[0].label_set)
    colors = quiet_colors(names)
    present = {item.label for scene in scenes for item in scene.objects}
    return [
        (name.replace("_", " "), f"#{bytes(color.tolist()).hex()}")
        for name, color in zip(names, colors, strict=True)
        if name in present
    ]


def input_views(shards: Path, rooms: int, views_per_room: int) -> list[tuple[str, str]]:
    """Input views of training: masks in class colours with 2D boxes, as (caption, data URI).

    The first rooms of the `train` split are shown, each in the views with most visible objects.
    """
    pictures: list[tuple[str, str]] = []
    for shard, room_id in islice(iterate_rooms(shards, "train"), rooms):
        visible = shard.read_room(room_id).visible.sum(1)
        best = np.argsort(-visible, kind="stable")[:views_per_room]
        pictures += [_input_view(shard, room_id, int(view)) for view in best]
    return pictures


def _input_view(shard: Shard, room_id: str, view: int) -> tuple[str, str]:
    room = shard.read_room(room_id)
    ids = shard.read_instance_ids(room_id, [view])[0].astype(np.int64)
    names = label_set(shard.label_set)
    colors = quiet_colors(names)[room.object_class]
    picture = Image.fromarray(paint_ids(ids, colors, _EMPTY))
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(size=11)
    height, width = ids.shape
    for row in np.flatnonzero(room.visible[view]):
        x1, y1, x2, y2 = room.boxes[view, row] * (width, height, width, height)
        dark = tuple(int(channel * 0.55) for channel in colors[row])
        draw.rectangle((x1, y1, x2 - 1, y2 - 1), outline=dark, width=2)
        label = names[int(room.object_class[row])].replace("_", " ")
        left, top, right, bottom = draw.textbbox((x1 + 4, y1 + 3), label, font=font)
        if right - left + 6 <= x2 - x1 and bottom - top + 6 <= y2 - y1:
            draw.rectangle((left - 2, top - 2, right + 2, bottom + 2), fill=dark)
            draw.text((x1 + 4, y1 + 3), label, font=font, fill="white")
    count = int(room.visible[view].sum())
    return f"{room_id}, view {view}: {count} objects", png_uri(picture.quantize(128))


def curves_svg(curves: dict[str, list[tuple[int, float]]]) -> str:
    """Learning curves as the data URI of one SVG, with one small panel per name.

    A panel whose values span more than a factor of 20 has a logarithmic axis.
    """
    import matplotlib

    # `Figure` rather than pyplot, so that the caller's backend stays as it is.
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator, NullFormatter

    columns = min(3, max(len(curves), 1))
    rows = -(-len(curves) // columns)
    figure = Figure(figsize=(11.4, 2.35 * rows), layout="constrained")
    FigureCanvasSVG(figure)
    for index, (name, points) in enumerate(curves.items()):
        axes = figure.add_subplot(rows, columns, index + 1)
        pairs = np.array(points, dtype=np.float64).reshape(-1, 2)
        pairs = pairs[np.isfinite(pairs).all(1)]
        pairs = pairs[:: max(1, -(-len(pairs) // _POINTS_PER_CURVE))]
        axes.plot(pairs[:, 0], pairs[:, 1], color="#3b5bdb", linewidth=1.4)
        if len(pairs) and pairs[:, 1].min() > 0 and np.ptp(np.log(pairs[:, 1])) > np.log(20):
            axes.set_yscale("log")
            axes.yaxis.set_minor_formatter(NullFormatter())
        axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        axes.set_title(name, fontsize=9, loc="left", color="#343a40")
        axes.tick_params(labelsize=8, colors="#868e96")
        axes.grid(color="#e9ecef", linewidth=0.8)
        axes.spines[:].set_visible(False)
        if index >= len(curves) - columns:
            axes.set_xlabel("epoch", fontsize=8, color="#868e96")
    page = io.BytesIO()
    # A fixed salt and no date: the same curves give the same bytes.
    with matplotlib.rc_context({"svg.hashsalt": "sceneprior"}):
        figure.savefig(page, format="svg", metadata={"Date": None})
    return data_uri("image/svg+xml", page.getvalue())
