"""The report page of a run: rooms, scores and curves in one self-contained HTML file."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from sceneprior.evaluation.ground_truth import known_in_3d, reference_scenes
from sceneprior.evaluation.metrics.decoded_rooms import match_scenes
from sceneprior.evaluation.page import faces_per_object, render
from sceneprior.evaluation.report_pictures import curves_svg, input_views, legend, room_pictures
from sceneprior.evaluation.score_table import headings, score_rows
from sceneprior.files import write_whole
from sceneprior.offscreen import Renderer
from sceneprior.scene import Scene
from sceneprior.shards import Shard, list_shards

ROOMS_SHOWN = 8
DECODED_SHOWN = 5
UNFOLDING_SHOWN = 9

_T = TypeVar("_T")


def write_report(
    path: Path,
    *,
    title: str,
    shards: Path,
    run: Path | str,
    generated: Sequence[Scene],
    scores: dict[str, Any],
    commands: Sequence[str],
    curves: dict[str, list[tuple[int, float]]],
    decoded: Sequence[tuple[Scene, Scene]],
    unfolding: Sequence[Scene],
    renderer: Renderer,
    from_boxes: bool = False,
) -> None:
    """Write one HTML file that needs nothing outside itself; rooms turn under the mouse.

    A part for which nothing is given is left out. The page names folders, never whole paths,
    so that it can be passed on.

    Args:
        shards: Input views come from `train`, real rooms from `test` if known in 3D.
        generated: Synthesized rooms; the first 8 are shown.
        scores: From `evaluate_synthesis`; class_accuracy, box_iou_3d, seconds and
            peak_memory_gib are shown too where they stand in it.
        curves: Points (epoch, value) by name; a panel each.
        decoded: (decoded, true) training rooms; the first 5 are shown.
        unfolding: Rooms along a geodesic of the hypersphere, from one room to another.
        from_boxes: Rooms come from a baseline that learnt from true boxes: it has no latent sphere,
            and saw no views.
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
        run=Path(run).resolve().name,
        shards=Path(shards).resolve().name,
        label_set=names.removeprefix("void,").replace(",", ", ").replace("_", " "),
        tiles=_tiles(scores),
        views=[] if from_boxes else input_views(shards, rooms=3, views_per_room=2),
        from_boxes=from_boxes,
        curves=curves_svg(curves) if curves else None,
        decoded=[_pair(*pair, renderer, most_faces) for pair in pairs],
        generated=[room_pictures(scene, renderer, most_faces) for scene in generated],
        test=[room_pictures(scene, renderer, most_faces) for scene in test],
        unfolding=[room_pictures(scene, renderer) for scene in along],
        legend=legend(shown),
        headings=headings(scores),
        rows=score_rows(scores),
        protocol_text=json.dumps(scores.get("protocol", {}), indent=1),
        note=scores.get("note"),
        commands=commands,
    )
    write_whole(path, page)


def _spread(items: Sequence[_T], count: int) -> list[_T]:
    """At most `count` items, both ends among them, evenly apart."""
    rows = np.linspace(0, len(items) - 1, min(count, len(items))).round().astype(int)
    return [items[row] for row in rows]


def _pair(decoded: Scene, truth: Scene, renderer: Renderer, most_faces: int) -> dict[str, Any]:
    match = match_scenes(decoded, truth)
    accuracy, iou = match.class_accuracy, match.mean_iou
    summary = (
        "an empty room"
        if accuracy is None or iou is None
        else f"{accuracy:.0%} of {match.truth_count} classes right, mean 3D box IoU {iou:.2f}"
    )
    # The true floor under both, so that both pictures frame the same room.
    rooms = {"decoded": replace(decoded, floor_m=truth.floor_m), "truth": truth}
    pictures = {name: room_pictures(scene, renderer, most_faces) for name, scene in rooms.items()}
    return {**pictures, "summary": summary}


_TILES = (
    ("type_share", "{0:.0%}", "hold their type's furniture",
     "{type_share_test:.0%} of real test rooms"),
    ("category_kl", "{0:.3f}", "category KL to test rooms",
     "nats; real training rooms {train_rooms[category_kl]:.3f}"),
    ("gap_closed_furnished", "{0:.0%}", "of the Frechet gap to real rooms closed",
     "independent objects with real meshes: 0; real training rooms: 1"),
    ("near_copy_share", "{0:.0%}", "near copies of a training room",
     "{near_copy_share_test:.0%} of real test rooms"),
    ("mean_objects", "{0:.2f}", "objects in a generated room",
     "real test rooms {mean_objects_test:.2f}"),
    ("class_accuracy", "{0:.1%}", "of true classes right",
     "decoded training rooms, matched by box"),
    ("mask_iou_held_out", "{0:.2f}", "mean mask IoU in held-out views", "decoded training rooms"),
    ("mask_iou_training_views", "{0:.2f}", "mean mask IoU in training views",
     "decoded training rooms; data.view_fraction below 1 holds views out"),
    ("box_iou_3d", "{0:.2f}", "mean 3D box IoU", "decoded training rooms; 3D was never shown"),
)  # fmt: skip
"""Key, value, what it is, beside what."""


def _tiles(scores: dict[str, Any]) -> list[tuple[str, str, str]]:
    """(value, what it is, beside what) for the top of the page; only what is known."""
    tiles = [
        (value.format(scores[key]), what, beside.format(**scores))
        for key, value, what, beside in _TILES
        if scores.get(key) is not None
    ]
    if "seconds" in scores:
        memory = scores.get("peak_memory_gib")
        beside = "" if memory is None else f"{memory:.1f} GiB of memory at most"
        tiles.append((f"{scores['seconds'] / 60:.1f} min", "from homes to scores", beside))
    return tiles
