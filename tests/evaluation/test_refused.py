"""What the evaluation refuses: sets of rooms, settings, and files of networks."""

import numpy as np
import pytest
import torch
from refusals import refused
from toy_metrics import of_classes

from sceneprior.core.errors import InputError, ShardError
from sceneprior.core.ground_truth import reference_scenes
from sceneprior.core.scene import Mesh, Scene
from sceneprior.evaluation.features import inception_features
from sceneprior.evaluation.metrics.contents import class_counts, common_label_set
from sceneprior.evaluation.metrics.picture_classifiers import alexnet_weights
from sceneprior.evaluation.metrics.picture_distances import frechet_distance
from sceneprior.evaluation.metrics.placement import outside_count
from sceneprior.evaluation.synthesis import EvalOptions, evaluate_synthesis
from sceneprior.evaluation.use import UseOptions, evaluate_use
from sceneprior.evaluation.view_scores import sample_surface, score_views
from sceneprior.render.offscreen import SoftwareRenderer

OTHER = Scene("a", "front3d_living", ())


def test_rooms_are_refused_before_anything_is_drawn(shards, tmp_path, monkeypatch):
    monkeypatch.setattr(SoftwareRenderer, "instance_ids", None, raising=True)
    rooms = reference_scenes(shards, "test", limit=3)
    with refused("evaluation/one_room"):
        evaluate_synthesis(rooms[:1], shards, EvalOptions())
    with refused("evaluation/other_labels"):
        evaluate_synthesis([OTHER] * 2, shards, EvalOptions())
    with refused("evaluation/no_shards", ShardError, tmp=tmp_path):
        evaluate_synthesis(rooms, tmp_path / "absent", EvalOptions())
    with refused("evaluation/no_inception", tmp=tmp_path):
        evaluate_synthesis(rooms, shards, EvalOptions(inception=tmp_path / "absent.pt"))


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("split", lambda: EvalOptions(split="train")),
        ("settle", lambda: UseOptions("some")),
        ("no_scenes", lambda: evaluate_use([], EvalOptions(), UseOptions(), None, None)),
        ("two_labels", lambda: common_label_set([OTHER], [of_classes("desk")])),
        ("nothing_counted", lambda: class_counts([])),
        ("one_picture", lambda: frechet_distance(np.zeros((1, 4)), np.zeros((3, 4)))),
        ("no_number", lambda: frechet_distance(np.zeros((2, 4)), np.full((3, 4), np.nan))),
        ("no_object", lambda: score_views([[]], ["a"])),
        ("no_faces", lambda: sample_surface(
            Mesh(np.zeros((3, 3)), np.zeros((0, 3), int)), 10, 0)),
        ("flat_floor", lambda: outside_count(Scene("a", "scannet", (), np.zeros((4, 2))))),
        ("short_floor", lambda: outside_count(Scene("a", "scannet", (), np.zeros((2, 2))))),
    ],
)  # fmt: skip
def test_arguments(name, call):
    with refused(f"evaluation/{name}"):
        call()


class Other(torch.nn.Module):
    def forward(self, img: torch.Tensor) -> torch.Tensor:
        return img.float()


def test_files_that_are_no_network(tmp_path):
    image = np.zeros((1, 32, 32, 3), np.uint8)
    (tmp_path / "text.pt").write_text("no network")
    torch.jit.script(Other()).save(str(tmp_path / "other.pt"))
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / "other.pth")
    # The reason that torch gives differs between its versions.
    for name in ("text.pt", "other.pt"):
        with pytest.raises(InputError, match="is not the Inception network of NVIDIA's"):
            inception_features(image, tmp_path / name)
    with pytest.raises(InputError, match="is not the state dict of torchvision's AlexNet"):
        alexnet_weights(tmp_path / "text.pt")
    for name in ("absent.pt", "other.pth"):
        with refused(f"evaluation/alexnet_{name}", tmp=tmp_path):
            alexnet_weights(tmp_path / name)
