"""The report page of a run or of a folder of scenes: rooms, scores and curves in one HTML file."""

import json
import string
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sceneprior.core.files import write_whole
from sceneprior.core.ground_truth import known_in_3d, reference_scenes
from sceneprior.core.overlaps import match_scenes
from sceneprior.core.scene import Scene
from sceneprior.core.shards import Shard, list_shards
from sceneprior.evaluation.page import faces_per_object, render
from sceneprior.evaluation.report_pictures import curves_svg, input_views, legend, room_pictures
from sceneprior.evaluation.score_table import (
    RELATION_HEADINGS,
    headings,
    relation_rows,
    score_rows,
)

ROOMS_SHOWN = 8
DECODED_SHOWN = 5
UNFOLDING_SHOWN = 9

_T = TypeVar("_T")


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
        scores: From `evaluate_synthesis`; class_accuracy, box_iou_3d, seconds and
            peak_memory_gib are shown too if present.
        views: Show the input views of training, for a method that learns from them.
        curves: Points (epoch, value) by name; one panel each.
        decoded: (decoded, true) training rooms.
        unfolding: Rooms along a geodesic of the hypersphere, from one room to another.
    """
    generated = list(generated)[:ROOMS_SHOWN]
    known = known_in_3d(shards, "test")
    test = reference_scenes(shards, "test", limit=ROOMS_SHOWN) if known else []
    with Shard(list_shards(shards, "train")[0]) as first:
        names = first.label_set
    along = _spread(unfolding, UNFOLDING_SHOWN)
    pairs = list(decoded)[:DECODED_SHOWN]
    shown = [*generated, *test, *along, *(scene for pair in pairs for scene in pair)]
    most_faces = faces_per_object([*generated, *test, *(scene for pair in pairs for scene in pair)])
    page = render(
        "report.html.jinja",
        title=title,
        source=source,
        made_by=made_by,
        shards=Path(shards).resolve().name,
        label_set=names.removeprefix("void,").replace(",", ", ").replace("_", " "),
        tiles=_tiles(scores),
        views=input_views(shards, rooms=3, views_per_room=2) if views else [],
        curves=curves_svg(curves) if curves else None,
        decoded=[_pair(*pair, most_faces) for pair in pairs],
        generated=[room_pictures(scene, most_faces) for scene in generated],
        test=[room_pictures(scene, most_faces) for scene in test],
        unfolding=[room_pictures(scene) for scene in along],
        legend=legend(shown),
        headings=headings(scores),
        rows=score_rows(scores),
        relation_headings=RELATION_HEADINGS,
        relations=relation_rows(scores),
        protocol_text=json.dumps(scores.get("protocol", {}), indent=1),
        note=scores.get("note"),
        commands=commands,
    )
    write_whole(path, page)


def _spread(items: Sequence[_T], count: int) -> list[_T]:
    """At most `count` items, evenly spaced, with the first and the last."""
    rows = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[row] for row in rows]


def _pair(decoded: Scene, truth: Scene, most_faces: int) -> dict[str, Any]:
    match = match_scenes(decoded, truth)
    accuracy, iou = match.class_accuracy, match.mean_iou
    summary = (
        "an empty room"
        if accuracy is None or iou is None
        else f"{percent(accuracy)} of {match.truth_count} classes right, mean 3D box IoU {iou:.2f}"
    )
    # Both scenes get the true floor, so that both pictures are framed alike.
    rooms = {"decoded": replace(decoded, floor_m=truth.floor_m), "truth": truth}
    pictures = {name: room_pictures(scene, most_faces) for name, scene in rooms.items()}
    return {**pictures, "summary": summary}


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
    ("mask_iou_held_out", "{0:.2f}", "mean mask IoU in held-out views", "decoded training rooms"),
    ("mask_iou_training_views", "{0:.2f}", "mean mask IoU in training views",
     "decoded training rooms; data.view_fraction below 1 holds views out"),
    ("box_iou_3d", "{0:.2f}", "mean 3D box IoU", "decoded training rooms; training uses no 3D"),
)  # fmt: skip
"""(key, format of the value, caption, reference values) of each tile; `%` formats by `percent`."""


class _Tile(string.Formatter):
    def format_field(self, value: Any, format_spec: str) -> Any:
        return percent(value) if format_spec == "%" else super().format_field(value, format_spec)


def percent(share: float) -> str:
    """A share in percent; only exact 0 and 1 are shown as 0% and 100%.

    >>> [percent(share) for share in (1.0, 0.9999, 0.995, 0.0001, 0.0)]
    ['100%', 'over 99.9%', '99.5%', 'under 0.1%', '0%']
    """
    if share in (0, 1):
        return f"{share:.0%}"
    if 0 < share < 0.0005:
        return "under 0.1%"
    return "over 99.9%" if 0.9995 <= share < 1 else f"{share:.1%}"


def _tiles(scores: dict[str, Any]) -> list[tuple[str, str, str]]:
    """(value, caption, reference values) of the tiles at the top of the page, for known keys."""
    tile = _Tile()
    tiles = [
        (tile.format(value, scores[key]), what, tile.format(beside, **scores))
        for key, value, what, beside in _TILES
        if scores.get(key) is not None
    ]
    if "seconds" in scores:
        memory = scores.get("peak_memory_gib")
        beside = "" if memory is None else f"{memory:.1f} GiB of memory at most"
        tiles.append((f"{scores['seconds'] / 60:.1f} min", "from homes to scores", beside))
    return tiles
