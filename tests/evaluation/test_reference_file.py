"""A reference file saves drawing, gives the same scores, and is refused where it does not fit."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from toy_metrics import without_classifiers
from toy_rooms import write_shard

from sceneprior.core.errors import InputError
from sceneprior.core.ground_truth import (
    reference_scenes,
    split_fingerprint,
    stream_scenes,
)
from sceneprior.core.scene import Scene
from sceneprior.evaluation import reference_file
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis


@pytest.fixture(scope="module", autouse=True)
def no_classifier():
    with pytest.MonkeyPatch.context() as patch:
        without_classifiers(patch)
        yield


@pytest.fixture(scope="module")
def generated(shards) -> list[Scene]:
    return [scene.without_meshes() for scene in reference_scenes(shards, "test", limit=3)]


@pytest.fixture(scope="module")
def stored(shards, renderer, generated, tmp_path_factory) -> tuple[Path, dict]:
    path = tmp_path_factory.mktemp("reference") / "new" / "reference.npz"
    scores = evaluate_synthesis(
        generated, shards, EvalOptions(seed=1, renderer=renderer, reference=path)
    )
    assert [item.name for item in path.parent.iterdir()] == ["reference.npz"]
    return path, scores


def score(generated, shards, renderer, path, **options):
    return evaluate_synthesis(
        generated, shards, EvalOptions(renderer=renderer, reference=path, resamples=0, **options)
    )


def test_with_and_without_a_file_scores_are_the_same(stored, shards, renderer, generated):
    path, first = stored
    assert first == evaluate_synthesis(generated, shards, EvalOptions(seed=1, renderer=renderer))
    assert first == evaluate_synthesis(
        generated, shards, EvalOptions(seed=1, renderer=renderer, reference=path)
    )


def test_any_choice_of_training_rooms_is_in_it_and_nothing_real_is_drawn_again(
    stored, shards, renderer, generated, monkeypatch
):
    path, _ = stored
    wanted = [
        score(generated[:count], shards, renderer, None, seed=seed)
        for count, seed in ((2, 5), (3, 6))
    ]

    def refuse(*_: object) -> None:
        raise AssertionError("a real room was drawn")

    monkeypatch.setattr(reference_file, "stream_scenes", refuse)
    for expected, (count, seed) in zip(wanted, ((2, 5), (3, 6)), strict=True):
        assert score(generated[:count], shards, renderer, path, seed=seed) == expected
    with pytest.raises(AssertionError, match="drawn"):
        score(generated, shards, renderer, None)


def test_other_rooms_or_renderers_or_networks_are_refused(
    stored, shards, renderer, generated, toy_room, tmp_path, monkeypatch
):
    path, _ = stored
    before = path.read_bytes()
    other = shutil.copytree(shards, tmp_path / "other")
    rooms = [toy_room(f"house/test_{row}", np.random.default_rng(9)) for row in range(5)]
    write_shard(other / "test" / "part_000.h5", "front3d_bedroom", rooms)
    with pytest.raises(InputError, match=r"reference\.npz does not fit: its 'test rooms'"):
        score(generated, other, renderer, path)
    monkeypatch.setattr(renderer, "name", "another machine")
    with pytest.raises(
        InputError, match=r"'render: renderer' .*\(software instead of another machine\)"
    ):
        score(generated, shards, renderer, path)
    monkeypatch.undo()
    monkeypatch.setitem(reference_file.__dict__, "VERSION", 2)
    with pytest.raises(InputError, match=r"'version' .*\(1 instead of 2\)"):
        score(generated, shards, renderer, path)
    assert path.read_bytes() == before


def test_a_file_must_know_what_is_asked_and_may_know_more(shards):
    def key(networks: dict, small: bool) -> dict:
        return {"networks": networks, "small pictures": small}

    effnet, inception = {"fd": 1}, {"fid": {"sha256": "a"}}
    check = reference_file._check_key
    check(Path("r"), key(effnet | inception, True), key(effnet, False))
    for came, wanted in (
        (key(effnet, False), key(effnet | inception, False)),
        (key(effnet | inception, False), key(effnet | {"fid": {"sha256": "b"}}, False)),
        (key(effnet, False), key(effnet, True)),
        ({}, key(effnet, False)),
    ):
        with pytest.raises(InputError, match=r"r does not fit: its '(networks|small pictures)'"):
            check(Path("r"), came, wanted)


def test_what_is_no_reference_is_a_sentence(shards, renderer, generated, tmp_path):
    path = tmp_path / "scores.npz"
    path.write_text("no numbers")
    with pytest.raises(InputError, match=r"scores\.npz is not a reference file of `eval-fid`"):
        score(generated, shards, renderer, path)
    np.savez(path, other=np.zeros(3))
    with pytest.raises(InputError, match=r"scores\.npz is not a reference file of `eval-fid`"):
        score(generated, shards, renderer, path)


def test_fingerprints_change_with_rooms_and_models_and_streams_keep_the_order(shards, tmp_path):
    assert split_fingerprint(shards, "test") == split_fingerprint(shards, "test")
    assert split_fingerprint(shards, "test") != split_fingerprint(shards, "train")
    other = shutil.copytree(shards, tmp_path / "other")
    assert split_fingerprint(other, "test") == split_fingerprint(shards, "test")
    model = other / "models" / "desk_v0.ply"
    model.write_bytes(model.read_bytes() + b" ")
    assert split_fingerprint(other, "test") != split_fingerprint(shards, "test")
    names = [scene.name for scene in stream_scenes(shards, "train", [5, 1, 2])]
    assert names == ["house/train_1", "house/train_2", "house/train_5"]
    (plain,) = reference_scenes(shards, "train", limit=1, meshes=False)
    assert all(item.mesh is None for item in plain.objects) and len(plain.objects) == 3
