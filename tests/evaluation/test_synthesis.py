"""The whole evaluation on toy rooms: keys, protocol, fairness, refusals."""

import json
import shutil
from dataclasses import replace

import pytest
from toy_metrics import without_classifiers

from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.parallel import run_tasks
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.evaluation import features, synthesis, use
from sceneprior.evaluation.score_table import headings, print_scores, score_rows
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.evaluation.use import UseOptions, evaluate_use


@pytest.fixture(scope="module")
def generated(shards) -> list[Scene]:
    scenes = reference_scenes(shards, "test", limit=3)
    return [replace(scene, objects=scene.objects[:2]) for scene in scenes]


@pytest.fixture
def no_classifier(monkeypatch):
    without_classifiers(monkeypatch)


def test_odd_sets_of_rooms_have_metrics_or_none_but_never_nan(shards, no_classifier):
    bed = SceneObject("double_bed", (0.0, 0.3, 0.0), (1.8, 0.6, 2.0))
    empty, one = Scene("a", "front3d_bedroom"), Scene("b", "front3d_bedroom", (bed,))
    for rooms in ([one] * 5, [empty, one]):
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


@pytest.mark.usefixtures("no_classifier")
def test_real_and_random_rooms_are_drawn_and_measured_once(
    generated, shards, tmp_path, monkeypatch
):
    """Later evaluations in a process have the first one's results, until the shards change."""
    folder, titles = shutil.copytree(shards, tmp_path / "shards"), []
    options = EvalOptions(resamples=5)

    def noted(function, tasks, title):
        titles.append(title)
        return run_tasks(function, tasks, title)

    def evaluated(rooms: list[Scene]) -> tuple[dict, list[str]]:
        titles.clear()
        scores = evaluate_synthesis(rooms, folder, options)
        return evaluate_use(rooms, options, UseOptions(), folder, scores), [*titles]

    for module in (features, use):
        monkeypatch.setattr(module, "run_tasks", noted)
    first, all_titles = evaluated(generated)
    assert len(all_titles) == 11
    again, some = evaluated(generated)
    assert json.dumps(again) == json.dumps(first)
    assert some == ["drawing generated rooms", "measuring generated rooms"]
    titles.clear()
    evaluate_synthesis(generated, folder, replace(options, boxes=True))
    boxed = [f"drawing boxed {name} rooms" for name in ("generated", "test", "train")]
    assert titles == ["drawing generated rooms", *boxed]
    options = EvalOptions(seed=1, resamples=5)
    warm, _ = evaluated(generated)
    synthesis._kept.clear()
    assert json.dumps(evaluated(generated)[0]) == json.dumps(warm)
    next((folder / "train").glob("*.h5")).touch()
    assert evaluated(generated)[1] == all_titles


@pytest.mark.usefixtures("no_classifier")
def test_mostly_empty_rooms_are_told_and_have_no_precision(generated, shards, capsys):
    rooms = [generated[0], *(replace(scene, objects=()) for scene in generated[:2])]
    scores = evaluate_synthesis(rooms, shards, EvalOptions(resamples=0))
    assert scores["note"].startswith(
        "2 of 3 generated rooms are empty, so none of the other scores can be trusted: train "
        "longer. Measured on"
    )
    assert scores["precision_effnet_lite0"] is None
    assert scores["train_rooms"]["precision_effnet_lite0"] is not None
    print_scores(scores)
    told = " ".join(capsys.readouterr().out.split())
    assert "2 of 3 generated rooms are empty" in told and "nan" not in told.lower()
    assert "Not measured without --boxes: fd_effnet_lite0_boxes, gap_closed_boxes." in told
    assert "without decoded training rooms: nearest_decoded_m." in told
