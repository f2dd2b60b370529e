"""All scores of four small rooms, as they stand in `golden/scores.csv`.

`TAKE=1 pytest ...` writes the file. A row is a metric of a set of rooms: its value, and the
ends of its interval.
"""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from golden_values import FOLDER, TAKE, assert_text

from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import Mesh, Opening, Scene, SceneObject, Turned
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.evaluation.use import UseOptions, evaluate_use
from sceneprior.evaluation.view_scores import score_views

LABELS = ("double_bed", "wardrobe", "desk", "nightstand", "chair", "ceiling_lamp", "shelf")
SIZES_M = ((1.8, 0.6, 2.0), (1.5, 2.1, 0.6), (1.2, 0.75, 0.6), (0.5, 0.5, 0.4), (0.5, 0.9, 0.5),
           (0.4, 0.4, 0.4), (0.9, 0.4, 0.3))  # fmt: skip


class MeanColors(torch.nn.Module):
    """Stands in for Inception: the features are the mean colours of sixteen columns."""

    def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        return img.float().mean(dim=2).unflatten(1, (3, 1)).reshape(len(img), 48, -1).mean(dim=2)


def mesh_of(kind: str, center_m: np.ndarray, size_m: np.ndarray) -> Mesh:
    made = {
        "ball": lambda: trimesh.creation.icosphere(subdivisions=2),
        "tube": lambda: trimesh.creation.cylinder(radius=0.5, height=1.0, sections=9),
    }[kind]()
    unit = (made.vertices - made.bounds.mean(axis=0)) / np.ptp(made.bounds, axis=0)
    return Mesh(unit * size_m + center_m, np.asarray(made.faces))


def made_rooms(count: int, seed: int) -> list[Scene]:
    """Rooms of boxes, balls and cylinders: some hang, overlap, stand in doors or outside.

    Every second one holds boxes alone, so that it can be simulated.
    """
    rng = np.random.default_rng(seed)
    rooms = []
    for number in range(count):
        half = np.array([2.0 + 0.25 * number, 1.75])
        items = []
        for row in rng.permutation(len(LABELS))[: 4 + number % 3]:
            size_m = np.array(SIZES_M[row])
            x, z = (rng.integers(-18, 19, 2) / 20) * half
            hung = {"ceiling_lamp": 2.2, "shelf": 1.2}.get(LABELS[row], 0.0)
            center_m = np.array([x, hung + size_m[1] / 2, z])
            shape = 2 * (number % 2 == 0) + rng.integers(4 if number % 2 else 2)
            mesh, turned, outer_m = None, None, size_m
            if shape < 2:
                mesh = mesh_of(("ball", "tube")[shape], center_m, size_m)
            elif shape == 2:
                yaw = rng.integers(-3, 4) * np.pi / 4
                turned = Turned(float(yaw), tuple(size_m.tolist()))
                cosine, sine = abs(np.cos(yaw)), abs(np.sin(yaw))
                outer_m = np.array([cosine * size_m[0] + sine * size_m[2], size_m[1],
                                    sine * size_m[0] + cosine * size_m[2]])  # fmt: skip
            items.append(
                SceneObject(LABELS[row], tuple(center_m.tolist()), tuple(outer_m.tolist()), mesh,
                            turned=turned)
            )  # fmt: skip
        (x, z) = half
        floor_m = np.array([[-x, -z], [x, -z], [x, z], [-x, z]])
        door = Opening("door", (-0.5, -z), (0.4, -z), 0.0, 2.0)
        window = Opening("window", (x, -0.6), (x, 0.6), 0.9, 2.1)
        rooms.append(
            Scene(f"made_{number}", "front3d_bedroom", tuple(items),
                  floor_m if number != 3 else None, ceiling_m=2.6 if number % 2 else None,
                  openings=(door, window) if number != 3 else ())
        )  # fmt: skip
    return rooms


def moved(scene: Scene, meters: float) -> Scene:
    """A room as a prior might decode it: its furniture aside, and one piece of another class."""
    items = [
        replace(item, mesh=None, center_m=(item.center_m[0] + meters, *item.center_m[1:]))
        for item in scene.objects
    ]
    return replace(scene, objects=(replace(items[0], label="chair"), *items[1:]))


@pytest.fixture(scope="module")
def scores(shards, tmp_path_factory) -> dict:
    folder = tmp_path_factory.mktemp("networks")
    torch.jit.script(MeanColors()).save(str(folder / "inception.pt"))
    options = EvalOptions(inception=folder / "inception.pt", boxes=True, resamples=20)
    rooms = made_rooms(4, 1)
    decoded = [moved(scene, 0.15) for scene in reference_scenes(shards, "train")]
    scores = evaluate_synthesis(rooms, shards, options, decoded)
    return evaluate_use(rooms, options, UseOptions("solids"), shards, scores)


def rows_of(scores: dict) -> dict[tuple[str, str], list[float | None]]:
    rows = {}
    for name, intervals in scores["intervals"].items():
        for key, interval in intervals.items():
            column, suffix = {"generated": (scores, ""), "test": (scores, "_test")}.get(
                name, (scores.get(name, {}), "")
            )
            rows[name, key] = [column[key + suffix], *(interval or (None, None))]
    for number, pair in enumerate(scores["relations"]):
        rows["relations", f"{number} {pair['of']} {pair['to']}"] = [
            pair["distance_m"], pair["train_m"], pair["near"]
        ]  # fmt: skip
    return rows


def rows_of_views() -> dict[tuple[str, str], list[float | None]]:
    """Scores of single-view reconstructions of the same rooms."""
    views = [
        [
            (true, found if row % 4 else None)
            for row, (true, found) in enumerate(
                zip(scene.objects, moved(scene, 0.1).objects, strict=True)
            )
        ]
        for scene in made_rooms(4, 1)
    ]
    scores = score_views(views, ["a", "a", "b", "c"], points=500)
    rows = {
        ("views", key): [value, *(scores["intervals"].get(key) or (None, None))]
        for key, value in scores["summary"].items()
    }
    for label, summary in scores["classes"].items():
        rows |= {(f"views {label}", key): [value, None, None] for key, value in summary.items()}
    return rows


def test_every_score_is_the_frozen_one(scores):
    found = rows_of(scores) | rows_of_views()
    path = FOLDER / "scores.csv"
    if TAKE:
        with path.open("w", newline="") as file:
            lines = csv.writer(file, lineterminator="\n")
            lines.writerow(("set", "metric", "value", "low", "high"))
            for (name, key), values in found.items():
                shown = ["" if value is None else f"{value:.9g}" for value in values]
                lines.writerow((name, key, *shown))
    with path.open(newline="") as file:
        known = {(name, key): values for name, key, *values in list(csv.reader(file))[1:]}
    assert list(found) == list(known)
    for row, values in found.items():
        wanted = [float(value) if value else None for value in known[row]]
        # Pictures' features are float32 sums, which differ between processors from the sixth digit.
        assert values == [
            None if value is None else pytest.approx(value, rel=1e-4, abs=1e-6) for value in wanted
        ], row


def test_the_protocol_is_the_frozen_one(scores):
    """What the values depend on, but for versions of packages and digests of files."""
    protocol = {key: scores["protocol"][key] for key in sorted(scores["protocol"])}
    protocol["packages"] = sorted(protocol["packages"])
    protocol["renders_sha256"] = sorted(protocol["renders_sha256"])
    del protocol["networks"]["fid"]["sha256"], protocol["shards"]
    text = json.dumps(protocol | {"note": scores["note"]}, indent=1) + "\n"
    assert_text("scores_protocol.json", text)
