"""The whole evaluation on toy rooms: keys, protocol, fairness, refusals."""

import io
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from toy_metrics import without_classifiers

from sceneprior.core.errors import InputError, ShardError
from sceneprior.core.files import write_json
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.evaluation.score_table import headings, print_scores, score_rows
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.render.offscreen import SoftwareRenderer


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


def test_what_cannot_be_scored_is_refused_before_anything_is_drawn(
    generated, shards, tmp_path, monkeypatch
):
    monkeypatch.setattr(SoftwareRenderer, "instance_ids", None, raising=True)
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
