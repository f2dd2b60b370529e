"""The GAN: its start, its two networks, its settings, and what it refuses."""

import pytest
import torch
from torch.testing import assert_close

from sceneprior.apps.config import load_run
from sceneprior.apps.reconstruction.reconstruct import FitOptions, reconstruct
from sceneprior.apps.sample import sample_rooms
from sceneprior.baselines.gan.semantic_maps import observed_maps
from sceneprior.baselines.gan.stage import GanStage
from sceneprior.core.dataset import ViewDataset
from sceneprior.core.errors import InputError
from sceneprior.paper.decode import decode_training_rooms
from sceneprior.paper.sampling import read_latent
from sceneprior.training.checkpoints import read_checkpoint
from sceneprior.training.fit import fit

CPU = {"accelerator": "cpu", "devices": 1}


@pytest.fixture
def fresh(baseline_config):
    """Makes an untrained module of a tiny run."""
    return lambda **changes: GanStage(baseline_config("gan", **changes))


def test_what_needs_latents_of_rooms_says_that_a_gan_has_none(baseline_run):
    trained = load_run(baseline_run("gan"))
    assert (
        trained.logits.shape == (0, 10)
        and trained.room_ids == ()
        and trained.distribution == "paper"
    )
    with pytest.raises(InputError) as error:
        decode_training_rooms(trained)
    assert str(error.value) == (
        "Decoding training rooms needs the latents of training rooms, and a run of `method: gan` "
        "keeps none; take a run of `method: paper` or `method: lifted`."
    )
    with pytest.raises(InputError, match="which keeps none"):
        read_latent(trained, "typo")
    with pytest.raises(InputError, match="Reconstruction needs the latents of training rooms"):
        reconstruct(trained, [], FitOptions())
    with pytest.raises(
        InputError, match="The kernel distribution needs the latents of at least 2 training rooms"
    ):
        sample_rooms(trained, 2, 0, "kernel")


def test_several_processes_are_refused(baseline_config, tmp_path):
    with pytest.raises(InputError, match=r"method: gan trains in one process, but 2 were asked"):
        fit(baseline_config("gan"), tmp_path / "a", trainer_options=CPU | {"devices": 2})
    assert not list(tmp_path.iterdir())


def test_maps_that_are_too_small_are_a_sentence(baseline_config, tmp_path):
    with pytest.raises(InputError, match=r"maps of \d x \d pixels are too small .*mask_step, or"):
        fit(baseline_config("gan", data__mask_step=30), tmp_path, trainer_options=CPU)


def test_each_opponent_learns_from_the_maps_and_the_average_follows(baseline_run, fresh):
    state = read_checkpoint(baseline_run("gan") / "gan" / "final.ckpt")["state_dict"]
    start = fresh().state_dict()
    moved = {part: 0 for part in ("generator", "discriminator", "prior")}
    for key, value in state.items():
        part = key.split(".")[0]
        if part in moved and not torch.equal(value, start[key]):
            moved[part] += 1
    assert all(moved.values())
    names = [key.removeprefix("prior.") for key in state if key.startswith("prior.layout")]
    assert all(
        not torch.equal(state[f"prior.{name}"], state[f"generator.{name}"]) for name in names
    )


def test_the_order_of_views_means_nothing_to_the_discriminator(fresh, toy_shards):
    views = ViewDataset(toy_shards, "train", views_per_room=3, mask_step=4).__getitems__(
        [(row, 0) for row in range(6)]
    )
    maps, judge = observed_maps(views, 22), fresh().discriminator.eval()
    (patches, room), (patches_turned, room_turned) = judge(maps), judge(maps.flip(1))
    assert_close(room_turned, room, rtol=0, atol=1e-5)
    assert_close(patches_turned.flip(1), patches, rtol=0, atol=1e-5)
