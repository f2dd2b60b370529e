"""The report page of a run or of a folder of scenes: rooms, scores and curves in one HTML file."""

import contextlib
import io
import json
import string
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from sceneprior.core.classes import label_set
from sceneprior.core.ground_truth import known_in_3d, reference_scenes
from sceneprior.core.scene import Scene
from sceneprior.core.shards import Shard, iterate_rooms, list_shards
from sceneprior.evaluation.metric import EMPTY
from sceneprior.evaluation.metrics.contents import reconstruction_scores
from sceneprior.evaluation.page import data_uri, png_uri, write_page
from sceneprior.evaluation.score_table import (
    RELATION_HEADINGS,
    headings,
    relation_rows,
    score_rows,
)
from sceneprior.render.appearance import paint_ids, quiet_colors

ROOMS_SHOWN = 8
DECODED_SHOWN = 5


def write_report(
    path: Path,
    *,
    title: str,
    source: str,
    made_by: str,
    shards: Path,
    generated: Sequence[Scene],
    scores: dict[str, Any],
    commands: Sequence[str],
    views: bool = False,
    curves: dict[str, list[tuple[int, float]]] | None = None,
    decoded: Sequence[tuple[Scene, Scene]] = (),
    unfolding: Sequence[Scene] = (),
) -> None:
    """Write one self-contained HTML file, with rooms that the mouse rotates.

    A part without data is left out. The page names folders, never whole paths, so that it can be
    passed on.

    Args:
        source: Origin of the rooms, such as `run bedrooms`.
        made_by: Description of the method that made the rooms, and of the method's random inputs.
        shards: Input views come from `train`, real rooms from `test` if known in 3D.
        scores: From `evaluate_synthesis`; class_accuracy, box_iou_3d and seconds are shown too if
            present.
        views: Show the input views of training, for a method that learns from them.
        curves: Points (epoch, value) by name; one panel each.
        decoded: (decoded, true) training rooms.
        unfolding: Rooms along a geodesic of the hypersphere, from one room to another.
    """
    known = known_in_3d(shards, "test")
    with Shard(list_shards(shards, "train")[0]) as first:
        names = first.label_set
    pairs = list(decoded)[:DECODED_SHOWN]
    write_page(
        path,
        "report.html.jinja",
        {
            "generated": generated[:ROOMS_SHOWN],
            "test": reference_scenes(shards, "test", limit=ROOMS_SHOWN) if known else [],
            # Both scenes get the true floor, so that both pictures are framed alike.
            "decoded": [replace(scene, floor_m=truth.floor_m) for scene, truth in pairs],
            "truth": [truth for _, truth in pairs],
            "unfolding": unfolding,
        },
        flat=["unfolding"],
        summaries=[_summary(*pair) for pair in pairs],
        title=title,
        source=source,
        made_by=made_by,
        shards=Path(shards).resolve().name,
        label_set=names.removeprefix("void,").replace(",", ", ").replace("_", " "),
        tiles=_tiles(scores),
        views=input_views(shards, rooms=3, views_per_room=2) if views else [],
        curves=curves_svg(curves) if curves else None,
        headings=headings(scores),
        rows=score_rows(scores),
        relation_headings=RELATION_HEADINGS,
        relations=relation_rows(scores),
        protocol_text=json.dumps(scores.get("protocol", {}), indent=1),
        note=scores.get("note"),
        commands=commands,
    )


def _summary(decoded: Scene, truth: Scene) -> str:
    found = reconstruction_scores([(decoded, truth)])
    accuracy, iou = found["class_accuracy"], found["box_iou_3d"]
    if accuracy is None or iou is None:
        return "an empty room"
    right = f"{percent(accuracy)} of {found['objects']} classes right"
    return f"{right}, mean 3D box IoU {iou:.2f}"


_TILES = (
    ("type_share", "{0:%}", "hold their type's furniture",
     "{type_share_test:%} of real test rooms"),
    ("layout_classifier_accuracy", "{0:.2f}", "accuracy of the layout classifier, 0.5 is best",
     "real rooms {train_rooms[layout_classifier_accuracy]:.2f}, shuffled furniture "
     "{shuffled[layout_classifier_accuracy]:.2f}"),
    ("relation_distance_m", "{0:.2f} m", "distance from real rooms' gaps between classes",
     "real training rooms {train_rooms[relation_distance_m]:.2f} m, shuffled furniture "
     "{shuffled[relation_distance_m]:.2f} m"),
    ("category_kl", "{0:.3f}", "category KL to test rooms",
     "nats; real training rooms {train_rooms[category_kl]:.3f}"),
    ("gap_closed_furnished", "{0:%}", "of the Frechet gap to real rooms closed",
     "independent objects with real meshes: 0; real training rooms: 1"),
    ("near_copy_share", "{0:%}", "near copies of a training room",
     "{near_copy_share_test:%} of real test rooms"),
    ("mean_objects", "{0:.2f}", "objects in a generated room",
     "real test rooms {mean_objects_test:.2f}"),
    ("class_accuracy", "{0:%}", "of true objects with the right class",
     "decoded training rooms, matched by box"),
    ("mask_iou_held_out", "{0:.2f}", "mean soft mask IoU in held-out views",
     "decoded training rooms"),
    ("mask_iou_training_views", "{0:.2f}", "mean soft mask IoU in training views",
     "decoded training rooms; data.view_fraction below 1 holds views out"),
    ("box_iou_3d", "{0:.2f}", "mean 3D box IoU", "decoded training rooms; training uses no 3D"),
)  # fmt: skip
"""(key, format of the value, caption, reference values) of each tile; `%` formats by `percent`."""


class _Tile(string.Formatter):
    """Formats numbers; what a result does not have is a dash."""

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> Any:
        with contextlib.suppress(LookupError, TypeError):
            return super().get_field(field_name, args, kwargs)
        return None, field_name

    def format_field(self, value: Any, format_spec: str) -> Any:
        if not isinstance(value, int | float):
            return "–"
        return percent(value) if format_spec == "%" else super().format_field(value, format_spec)


def percent(share: float) -> str:
    """A share in percent; only exact 0 and 1 are shown as 0% and 100%.

    >>> [percent(share) for share in (1.0, 0.9999, 0.995, 0.0001, 0.0)]
    ['100%', 'over 99.9%', '99.5%', 'under 0.1%', '0%']
    """
    if share < 0:  # of a gap that became wider
        return "below 0%"
    if share in (0, 1):
        return f"{share:.0%}"
    if 0 < share < 0.0005:
        return "under 0.1%"
    return "over 99.9%" if 0.9995 <= share < 1 else f"{share:.1%}"


def _tiles(scores: dict[str, Any]) -> list[tuple[str, str, str]]:
    """(value, caption, reference values) of the tiles at the top of the page, for known keys. If
    most rooms are empty, only their number of objects has a meaning."""
    tile, is_empty = _Tile(), EMPTY in scores.get("note", "")
    tiles = [
        (
            tile.format("–" if is_empty and key != "mean_objects" else value, scores[key]),
            what,
            tile.format(beside, **scores),
        )
        for key, value, what, beside in _TILES
        if scores.get(key) is not None
    ]
    if "seconds" in scores:
        tiles.append((f"{scores['seconds'] / 60:.1f} min", "for the commands below", ""))
    return tiles


_POINTS_PER_CURVE = 400
_EMPTY = (244, 245, 247)


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
