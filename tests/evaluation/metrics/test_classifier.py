"""Classifier of real and generated rooms: accuracy 0.5 on equal sets, 1 on different ones, and no
room classified by a model trained on it."""

import numpy as np
import pytest
import torch

from sceneprior.core.errors import InputError
from sceneprior.evaluation.metric import resample_counts
from sceneprior.evaluation.metrics.picture_classifiers import (
    FOLDS,
    REPEATS,
    check_alexnet,
    classify_pictures,
    cross_validated_predictions,
)


def accuracy(told, resamples: int = 50):
    generated = resample_counts(len(told.asked_generated), resamples, 0)
    return told.accuracy(generated, resample_counts(len(told.asked_real), resamples, 1))


def test_sets_of_one_distribution_are_at_chance_and_far_ones_are_told_apart(rng):
    a, b = rng.normal(size=(60, 8)), rng.normal(size=(45, 8))
    estimate = accuracy(cross_validated_predictions(a, b, seed=0))
    low, high = estimate.interval()
    assert low < 0.5 < high and 0.3 < estimate.value < 0.7
    estimate = accuracy(cross_validated_predictions(a, b + 10, seed=0))
    assert estimate.value == 1 and estimate.interval() == [1, 1]


def test_answers_are_those_of_folds_never_seen_with_equal_numbers_on_both_sides(rng):
    calls = []

    def remember(inputs, labels, others, seed):
        assert set(inputs[:, 0]).isdisjoint(others[:, 0])
        assert abs(2 * labels.sum() - len(labels)) <= 1
        calls.append((len(inputs), len(others), seed))
        return np.ones(len(others), dtype=int)  # all are generated, it says

    told = cross_validated_predictions(
        np.arange(20.0)[:, None], 100 + np.arange(7.0)[:, None], 1, remember
    )
    assert len(calls) == FOLDS * REPEATS and len({seed for *_, seed in calls}) == len(calls)
    assert told.asked_real.tolist() == [REPEATS] * 7 and not told.right_real.any()
    assert told.asked_generated.sum() == 7 * REPEATS
    np.testing.assert_array_equal(told.right_generated, told.asked_generated)
    assert accuracy(told).value == 0.5


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """A state dict of torchvision's names and shapes, with drawn numbers."""
    generator = torch.Generator().manual_seed(0)
    shapes = {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3)}
    shapes[10] = (256, 256, 3)
    state = {}
    for number, (outside, inside, side) in shapes.items():
        fan = (inside * side * side) ** -0.5
        shape = (outside, inside, side, side)
        state[f"features.{number}.weight"] = fan * torch.randn(shape, generator=generator)
        state[f"features.{number}.bias"] = torch.zeros(outside)
    path = tmp_path_factory.mktemp("alexnet") / "alexnet-owt-7be5be79.pth"
    torch.save(state | {"classifier.1.bias": torch.zeros(4096)}, path)
    return path


def test_alexnet_tells_dark_pictures_from_light_ones_and_leaves_torchs_seed_alone(weights, rng):
    level = np.repeat([40, 215], 4)
    noise = rng.integers(-30, 30, (8, 224, 224, 3))
    pictures = (level[:, None, None, None] + noise).astype(np.uint8)
    labels = (level > 128).astype(int)
    before = torch.get_rng_state()
    answers = classify_pictures(weights, pictures[::2], labels[::2], pictures[1::2], seed=1)
    assert torch.equal(before, torch.get_rng_state())
    np.testing.assert_array_equal(answers, labels[1::2])


def test_files_that_are_no_alexnet_are_named(weights, tmp_path):
    check_alexnet(weights)
    with pytest.raises(InputError, match="No AlexNet at"):
        check_alexnet(tmp_path / "absent.pth")
    (tmp_path / "text.pth").write_text("no network")
    with pytest.raises(InputError, match="not the state dict of torchvision's AlexNet"):
        check_alexnet(tmp_path / "text.pth")
    state = torch.load(weights, weights_only=True)
    torch.save(state | {"features.3.weight": torch.zeros(1)}, tmp_path / "other.pth")
    with pytest.raises(InputError, match=r"features\.3\.weight has shape \(1,\)"):
        check_alexnet(tmp_path / "other.pth")
