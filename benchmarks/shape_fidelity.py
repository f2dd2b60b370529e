"""Chamfer distance and volumetric IoU between decoded training objects and true ones, by class.

Run `python benchmarks/shape_fidelity.py RUN`. The rows compare three kinds of decoded shapes with
the true meshes, which training does not use: the layout stage's boxes, drawn as the inscribed
ellipsoids (the paper's proxy) and as boxes (in a run of one stage, that stage's boxes), and the
final meshes. Objects are matched by boxes (`match_scenes`), each object has the same weight, and
points are sampled with a fixed seed. Two more tables list the distance and the IoU by class.

Two rows are limits: the true solids, scaled into the decoded boxes, are the best shape that outside
views could give; the true surfaces, sampled again, give the distance between two samples of the
same surface.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from statistics import mean
from typing import NamedTuple

import numpy as np
from PIL import Image
from trimesh.voxel.encoding import DenseEncoding
from trimesh.voxel.morphology import fill_orthographic

from sceneprior.apps.api import load
from sceneprior.apps.experiments.evaluate import decoded_and_true
from sceneprior.core.boxes import match_scenes
from sceneprior.core.proxies import icosphere
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.core.surfaces import chamfer_of, nearest_distances, surface_of
from sceneprior.evaluation.metrics.contents import reconstruction_scores
from sceneprior.evaluation.metrics.picture_distances import FRECHET
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.evaluation.view_scores import f_score, sample_surface
from sceneprior.paper.prior import TrainedPrior
from sceneprior.render.appearance import box_mesh, contact_sheet
from sceneprior.render.topdown import corner_view, perspective

SPHERE_LEVEL = 3
SOLID_CELLS, SOLID_POINTS = 32, 50_000
SHEET_ROOMS, SHEET_COLUMNS, TILE_PX = 24, 6, (210, 280)


def ellipsoid(item: SceneObject, _: SceneObject) -> Mesh:
    """The ellipsoid inscribed in the object's box."""
    vertices, faces = icosphere(SPHERE_LEVEL)
    placed = vertices.numpy() * np.array(item.size_m) / 2 + np.array(item.center_m)
    return Mesh(placed, faces.numpy())


def box(item: SceneObject, _: SceneObject) -> Mesh:
    """The object's box."""
    return box_mesh(item.center_m, item.size_m)


def own(item: SceneObject, _: SceneObject) -> Mesh:
    """The decoded mesh."""
    assert item.mesh is not None, "the shape stage ends with meshes"
    return item.mesh


class Fidelity(NamedTuple):
    """Scores of one object's shape against the true shape."""

    label: str
    """The true class."""
    chamfer_m: float
    """Chamfer distance L2, the sum of both directions."""
    f_score: float
    volume_iou: float
    """See the function `volume_iou`."""


def solid_cells(mesh: Mesh, low_m: np.ndarray, high_m: np.ndarray, cells: int) -> np.ndarray:
    """Voxels of a mesh as a solid, in a grid between two corners.

    A voxel is solid if it contains surface, or lies between such voxels along all three axes. This
    fills furniture that is modelled hollow, open or in pieces, but not the air below a table.
    """
    points = sample_surface(mesh, SOLID_POINTS, 0)
    at = ((points - low_m) / (high_m - low_m).clip(1e-9) * cells).astype(int)
    grid = np.zeros((cells,) * 3, dtype=bool)
    grid[tuple(at.clip(max=cells - 1).T)] = True
    return fill_orthographic(DenseEncoding(grid)).dense


def volume_iou(a: Mesh, b: Mesh) -> float:
    """Intersection over union of two solids, on 32 voxels along each axis of their joint box.

    A voxel that contains surface counts as full: two cubes with an IoU of 1 / 3 get 0.375.
    """
    ends = [(mesh.vertices_m.min(axis=0), mesh.vertices_m.max(axis=0)) for mesh in (a, b)]
    low_m, high_m = np.minimum(*(low for low, _ in ends)), np.maximum(*(high for _, high in ends))
    one, other = (solid_cells(mesh, low_m, high_m, SOLID_CELLS) for mesh in (a, b))
    return float((one & other).sum() / (one | other).sum())


def true_solid(item: SceneObject, truth: SceneObject) -> Mesh:
    """The true object as a voxelised solid, scaled into the decoded object's box."""
    assert truth.mesh is not None, "asked for meshes"
    corners = truth.mesh.vertices_m
    filled = solid_cells(truth.mesh, corners.min(axis=0), corners.max(axis=0), SOLID_CELLS)
    padded = np.pad(filled, 1) - 0.5
    margin = (SOLID_CELLS + 2) / SOLID_CELLS
    return Mesh(*surface_of(padded, np.array(item.center_m), np.array(item.size_m), margin))


def true_surface(item: SceneObject, truth: SceneObject) -> Mesh:
    """The true object itself."""
    assert truth.mesh is not None, "asked for meshes"
    return truth.mesh


def distances(
    pairs: list[tuple[Scene, Scene]],
    shape: Callable[[SceneObject, SceneObject], Mesh],
    points: int,
) -> list[Fidelity]:
    """Scores of every matched object, with a shape computed by `shape(decoded, true)`."""
    found = []
    for decoded, truth in pairs:
        match = match_scenes(decoded, truth)
        for mine, true in zip(match.decoded, match.truth, strict=True):
            target = truth.objects[true]
            assert target.mesh is not None, "asked for meshes"
            mesh = shape(decoded.objects[mine], target)
            a, b = sample_surface(mesh, points, 0), sample_surface(target.mesh, points, 1)
            volumes = volume_iou(mesh, target.mesh)
            chamfer_m = chamfer_of(*nearest_distances(a, b)).l2_m
            found.append(Fidelity(target.label, chamfer_m, f_score(a, b), volumes))
    return found


def figures(pairs: list[tuple[Scene, Scene]], shards: Path) -> dict[str, float | None]:
    """3D box IoU of decoded training rooms, and Frechet distances to the test rooms, in
    EfficientNet-Lite0 features, from the decoded and from the true training rooms.
    """
    options = EvalOptions(resamples=0)
    scores = evaluate_synthesis([decoded for decoded, _ in pairs], shards, options)
    key = FRECHET["effnet_lite0"]
    return {
        "box_iou_3d": reconstruction_scores(pairs)["box_iou_3d"],
        "fd_decoded": scores[key],
        "fd_real": scores["train_rooms"][key],
    }


def sheet(pairs: list[tuple[Scene, Scene]]) -> Image.Image:
    """Contact sheet of random training rooms, each with its decoded version to the right."""
    rows = np.random.default_rng(0).permutation(len(pairs))[:SHEET_ROOMS]
    tiles = []
    for row in sorted(rows):
        decoded, truth = pairs[row]
        view = corner_view([truth], TILE_PX)
        tiles += [perspective(scene, view=view) for scene in (truth, decoded)]
    return Image.fromarray(contact_sheet(tiles, SHEET_COLUMNS, gap_px=4))


def print_by_class(rows: dict[str, list[Fidelity]], figure: Callable[[Fidelity], float]) -> None:
    """Print a Markdown table with one row per class and one column per shape."""
    print(f"\n| class | objects | {' | '.join(rows)} |")
    print(f"| --- | ---: |{' ---: |' * len(rows)}")
    for label in sorted({item.label for found in rows.values() for item in found}):
        columns = [
            [figure(item) for item in found if item.label == label] for found in rows.values()
        ]
        cells = " | ".join(f"{mean(column):.3f}" if column else "-" for column in columns)
        print(f"| {label} | {len(columns[-1])} | {cells} |")


def main() -> None:
    """Print a table in Markdown."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("run", type=Path)
    options.add_argument("--points", type=int, default=2000, help="points on each surface")
    options.add_argument("--rooms", type=int, help="rooms compared by surface (default: all)")
    options.add_argument("--json", type=Path, help="file for five of the numbers")
    options.add_argument("--sheet", type=Path, help="file for a picture of 24 rooms (PNG)")
    given = options.parse_args()
    trained = load(given.run).with_latents
    shards = Path(trained.config.data.shards)
    shaped = layout = decoded_and_true(trained, shards, meshes=True)
    if "layout" in trained.config.stage_names:
        boxes = trained.config.load("layout", given.run / "layout" / "final.ckpt")
        assert isinstance(boxes, TrainedPrior), "the run has latents, as above"
        layout = decoded_and_true(boxes, shards, meshes=True)
    order = np.random.default_rng(0).permutation(len(shaped))[: given.rooms]
    flat, full = ([pairs[row] for row in order] for pairs in (layout, shaped))
    rows = {
        "ellipsoids in the layout's boxes": distances(flat, ellipsoid, given.points),
        "the layout's boxes": distances(flat, box, given.points),
        "the decoded meshes": distances(full, own, given.points),
        "the true solids in decoded boxes": distances(full, true_solid, given.points),
        "the true surfaces, drawn again": distances(full, true_surface, given.points),
    }
    base = mean(item.chamfer_m for item in rows["ellipsoids in the layout's boxes"])
    objects = len(rows["the layout's boxes"])
    print(f"{given.run.resolve().name}: {len(order)} training rooms, {objects} objects")
    columns = "Chamfer distance L2, m", "against the first row", "F-score at 5 cm", "volumetric IoU"
    print(f"| shape | {' | '.join(columns)} |")
    print(f"| --- |{' ---: |' * len(columns)}")
    for name, found in rows.items():
        middle = mean(item.chamfer_m for item in found)
        score = mean(item.f_score for item in found)
        volumes = mean(item.volume_iou for item in found)
        print(f"| {name} | {middle:.4f} | {middle / base - 1:+.0%} | {score:.3f} | {volumes:.3f} |")
    print("\nChamfer distance L2 in metres by class:")
    print_by_class(rows, lambda item: item.chamfer_m)
    print("\nVolumetric IoU by class:")
    print_by_class(rows, lambda item: item.volume_iou)
    if given.sheet:
        sheet(shaped).save(given.sheet, optimize=True)
    if given.json:
        ours = mean(item.chamfer_m for item in rows["the decoded meshes"])
        volumes = mean(item.volume_iou for item in rows["the decoded meshes"])
        scores: dict[str, float | None] = {
            "chamfer_over_ellipsoid": ours / base,
            "volume_iou": volumes,
        }
        scores |= figures(shaped, shards)
        print(scores)
        given.json.write_text(json.dumps(scores, indent=1) + "\n")


if __name__ == "__main__":
    main()
