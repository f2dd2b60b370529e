"""Quality of new rooms against the number of training rooms.

    python benchmarks/rooms_needed.py OUT [--sizes 150 500 5000] [--seed 0]

For each size, the script makes homes, prepares views, and trains `configs/demo.yaml` on the lifted
boxes and shapes of that many training rooms: for as many steps at each size, and for more where
each room would be seen too seldom. All sets come from one seed, so larger sets include the rooms of
smaller sets. All priors are evaluated on those test rooms of the largest set that no smaller set
has among its training rooms, and the layout classifier is trained on the largest set's training and
val rooms; an accuracy of 0.5 is best.
`relations` is the Wasserstein distance of gaps between classes in metres. Both metrics are printed
for rooms of the sampler, for rooms from anywhere on the sphere (`paper`), for decoded training
rooms, and for real training rooms. CPU minutes are those of `fit` (lifting included) and of
preparation.

Steps whose results are in OUT are not repeated.
"""

import argparse
import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import torch
from requested_rooms import accuracy

import sceneprior
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import Scene
from sceneprior.core.shards import iterate_rooms
from sceneprior.evaluation.metric import Comparison, RoomSet
from sceneprior.evaluation.metrics.layouts import relation_distance
from sceneprior.paper.sampling import decode_training_rooms

TRAIN_SHARE = 0.7
"""Share of made homes in the train split."""
STEPS = {"shape": 3000, "sampler": 2000}
"""Training steps of the sphere and of the sampler, at least."""
EPOCHS = {"shape": 112, "sampler": 32}
"""Epochs, at least: 3,000 steps are too few for the latents of 1,500 rooms."""
BATCH = {"shape": 28, "sampler": 24}
SETS = {"sampler": "sampler", "paper": "sphere, anywhere", "decoded": "decoded training rooms"}
"""Sets of rooms, with their names in the plot."""
DRAWN = 600


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--sizes", type=int, nargs="+", default=[150, 500, 5000])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    out, sizes = arguments.out, sorted(arguments.sizes)
    torch.set_num_threads(1)
    for size in sizes:
        train(out / str(size), size, arguments.seed)
    shards = out / str(sizes[-1]) / "shards"
    real = scenes_of(shards, "train") + scenes_of(shards, "val")
    # The split of a home changes with the number of homes.
    taught = {
        room_id
        for size in sizes[:-1]
        for _, room_id in iterate_rooms(out / str(size) / "shards", "train")
    }
    test = [room for room in scenes_of(shards, "test") if room.name not in taught]
    few = np.random.default_rng(arguments.seed).permutation(len(real))[:DRAWN]
    print(f"{len(test)} test rooms; {DRAWN} rooms drawn with seed {arguments.seed}")
    some = [real[k] for k in few]
    print(f"real training rooms: relations {relations(some, real, test):.2f} m")
    rows: list[dict[str, Any]] = []
    for size in sizes:
        folder = out / str(size)
        prior = sceneprior.load(folder / "run")
        spent = json.loads((folder / "cpu_minutes.json").read_text())
        for name in SETS:
            if name == "decoded":
                known = decode_training_rooms(prior.trained)
                chosen = np.random.default_rng(arguments.seed).permutation(len(known))[:DRAWN]
                rooms = [known[k] for k in chosen]
            else:
                rooms = prior.sample(DRAWN, seed=arguments.seed, distribution=name)
            rooms = [room.without_meshes() for room in rooms]
            row = {
                "rooms": size,
                "set": name,
                "classifier": accuracy(rooms, real, test, arguments.seed),
                "relations_m": round(relations(rooms, real, test), 3),
                "prepare_cpu_min": round(spent["prepare"], 1),
                "fit_cpu_min": round(spent["fit"], 1),
            }
            print(json.dumps(row), flush=True)
            rows.append(row)
    (out / "rooms_needed.json").write_text(json.dumps(rows, indent=1) + "\n")
    if arguments.plot:
        plot(rows, arguments.plot)


def train(folder: Path, size: int, seed: int) -> None:
    """Make homes, shards and a run with `size` training rooms, and note the CPU minutes spent."""
    done = folder / "cpu_minutes.json"
    if done.exists():
        return
    homes, shards = folder / "homes", folder / "shards"
    rooms = round(size / TRAIN_SHARE)
    spent = 0.0
    if not homes.exists():
        spent += command("make-homes", homes, "--rooms", str(rooms), "--seed", str(seed))
    spent += command(
        "prep-front", "--front", homes / "3D-FRONT", "--future", homes / "3D-FUTURE-model",
        "--splits", homes / "splits" / "bedroom.csv", "--recipe", "bedroom", "--workers", "1",
        "--out", shards,
    )  # fmt: skip
    taught = len(scenes_of(shards, "train"))
    sets = [f"data.shards={shards}", f"seed={seed}"]
    for name, steps in STEPS.items():
        sets.append(f"{name}.epochs={max(EPOCHS[name], -(-steps * BATCH[name] // taught))}")
    fit: list[str | Path] = ["fit", "--config", "demo.yaml", "--run", folder / "run", "--resume"]
    minutes = command(*fit, *(word for each in sets for word in ("--set", each)))
    done.write_text(json.dumps({"prepare": spent, "fit": minutes, "train_rooms": taught}) + "\n")


def command(*words: str | Path) -> float:
    """Run a command of the package and return its CPU minutes."""
    start = os.times()
    subprocess.run([sys.executable, "-m", "sceneprior", *map(str, words)], check=True)
    end = os.times()
    return (
        end.children_user + end.children_system - start.children_user - start.children_system
    ) / 60


def scenes_of(shards: Path, split: str) -> list[Scene]:
    """The rooms of a split with their true boxes."""
    return list(reference_scenes(shards, split, meshes=False))


def relations(rooms: Sequence[Scene], real: Sequence[Scene], test: Sequence[Scene]) -> float:
    """`relation_distance_m` of a set of rooms, without an interval."""
    # The metric reads no pictures and no nearest rooms.
    own, others = (
        cast(RoomSet, SimpleNamespace(scenes=scenes, counts=np.ones((1, len(scenes)), dtype=int)))
        for scenes in (rooms, test)
    )
    found = relation_distance(own, cast(Comparison, SimpleNamespace(test=others, real=real)))
    assert found.value is not None
    return found.value


def plot(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw both metrics against the number of rooms, with a line for each set."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3), layout="constrained")
    FigureCanvasAgg(figure)
    for column, (key, title) in enumerate(
        (("classifier", "layout classifier (0.5 is best)"), ("relations_m", "gaps, m (0 is best)"))
    ):
        axes = figure.add_subplot(1, 2, column + 1)
        for name, label in SETS.items():
            mine = [row for row in rows if row["set"] == name]
            axes.plot([r["rooms"] for r in mine], [r[key] for r in mine], marker="o", label=label)
        axes.set_xscale("log")
        axes.set_xticks(sizes := sorted({row["rooms"] for row in rows}), map(str, sizes))
        axes.minorticks_off()
        axes.set_xlabel("training rooms")
        axes.set_title(title, fontsize=10)
        axes.grid(alpha=0.3)
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=len(SETS))
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    main()
