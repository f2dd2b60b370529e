"""Losses of a first batch and results of untrained networks, as they stand in a golden file.

`TAKE=1 pytest ...` writes `golden/baselines.csv`.
"""

import csv

import pytest
import torch
from golden_values import FOLDER, TAKE
from pydantic import TypeAdapter
from torch.nn import functional as F

from sceneprior.apps.decoders import Decoder
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.views import RoomBoxes
from sceneprior.training.fit import fit

GOLDEN = FOLDER / "baselines.csv"
METHODS = ("gan", "atiss", "sync2gen", "set_flow", "usl", "total3d", "im3d")


def compare(method: str, found: dict[str, float]) -> None:
    with GOLDEN.open(newline="") as file:
        known = {(of, name): float(value) for of, name, value in list(csv.reader(file))[1:]}
    if TAKE:
        known = {key: value for key, value in known.items() if key[0] != method}
        known |= {(method, name): value for name, value in found.items()}
        with GOLDEN.open("w", newline="") as file:
            lines = csv.writer(file, lineterminator="\n")
            lines.writerow(("method", "name", "value"))
            lines.writerows((*key, f"{known[key]:.8g}") for key in sorted(known))
    wanted = {name: value for (of, name), value in known.items() if of == method}
    # float32 sums in another order on another processor.
    assert found == {
        name: pytest.approx(value, rel=2e-4, abs=2e-5) for name, value in wanted.items()
    }


def told(rooms: RoomBoxes) -> dict[str, float]:
    """Numbers that change with any class, box or yaw of sampled rooms."""
    weights = torch.linspace(1, 2, rooms.boxes_m[rooms.is_object].numel()).view(-1, 6)
    yaws = {} if rooms.yaw_rad is None else {"yaws": rooms.yaw_rad[rooms.is_object].cos().mean()}
    return {
        "objects": rooms.is_object.sum(),
        "classes": (rooms.object_class * torch.arange(1, 1 + rooms.object_class.shape[1])).sum(),
        "boxes": (weights * rooms.boxes_m[rooms.is_object]).mean(),
        **yaws,
    }


@pytest.mark.parametrize("method", METHODS)
def test_the_first_losses_and_results_are_the_frozen_ones(
    baseline_config, toy_shards, tmp_path, method
):
    config = baseline_config(method, training__epochs=1, training__batch_size=12)
    fit(config, tmp_path / "run", trainer_options={"accelerator": "cpu"})
    with (tmp_path / "run" / method / "metrics.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["train/loss"]]
    assert len(rows) == 1
    found = {key: float(value) for key, value in rows[0].items() if key.startswith("train/")}
    (stage,) = config.stages()
    prior = stage.build(stage.open_data(), None).prior.eval()
    if method == "gan":
        with torch.no_grad():
            points = prior.latent_space(
                torch.randn(6, 10, generator=torch.Generator().manual_seed(0))
            )
            scenes = prior.decode(points)
        results = {
            name: part.square().mean()
            for name, part in (
                ("classes", scenes.class_logits.softmax(dim=-1)),
                ("centers", scenes.centers_m),
                ("sizes", scenes.sizes_m),
                ("completeness", scenes.completeness_logits),
                ("meshes", scenes.vertices_m),
            )
        }
    elif hasattr(prior, "sample"):
        results = told(prior.sample(12, 5))
    else:
        data = ViewDataset(toy_shards, "train", views_per_room=1, mask_step=2, seed=4)
        objects = [
            item for room in prior.find(data.__getitems__([(0, 0), (3, 0)])) for item in room
        ]
        meshes = [torch.as_tensor(item.mesh.vertices_m) for item in objects]
        results = {
            "objects": len(objects),
            "centers": torch.tensor([item.center_m for item in objects]).square().mean(),
            "sizes": torch.tensor([item.size_m for item in objects]).square().mean(),
            "meshes": torch.cat(meshes).square().mean(),
        }
    compare(method, found | {f"result/{name}": float(value) for name, value in results.items()})


@pytest.mark.parametrize("name", ("lstm", "atiss2d"))
def test_decoders_answer_as_frozen(torch_rng, name):
    torch.manual_seed(0)
    options = {} if name == "lstm" else {"heads": 2, "hidden": 24}
    decoder = TypeAdapter(Decoder).validate_python({"name": name, **options}).build(12, 6).eval()
    z = F.normalize(torch.randn(3, 12, generator=torch_rng), dim=-1)
    with torch.no_grad():
        features = decoder(z, 6)
    weights = torch.linspace(1, 2, features.numel()).view_as(features)
    compare(name, {"result/features": float((weights * features.square()).mean())})
