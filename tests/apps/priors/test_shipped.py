"""The priors of the package: small, with a card, and without what must not be passed on."""

import zipfile

import pytest
import torch

from sceneprior.apps.config import load_run
from sceneprior.apps.priors.packed import FILES, read_packed
from sceneprior.apps.priors.where import shipped_priors
from sceneprior.apps.sample import sample_rooms

SHIPPED = shipped_priors()


@pytest.fixture(params=SHIPPED)
def name(request) -> str:
    return request.param


def test_they_are_small_and_hold_latents_of_rooms_made_here_alone(name):
    assert SHIPPED[name].stat().st_size < 4e6
    packed = read_packed(SHIPPED[name])
    made_here = name.startswith("demo-")
    assert bool(packed.said.room_ids) == made_here
    assert bool(len(packed.tensors["latents.weight"])) == made_here
    assert "/" not in packed.said.settings["data"]["shards"]
    with zipfile.ZipFile(SHIPPED[name]) as archive:
        assert tuple(archive.namelist()) == FILES


def test_their_cards_credit_the_data_and_say_how_they_were_made_and_how_good_they_are(name):
    card = read_packed(SHIPPED[name]).card
    assert SHIPPED[name].with_suffix(".md").read_text() == card  # for readers of the repository
    for needed in ("## Data, authors and licence", "sceneprior pack", "seed 0", "## Limits"):
        assert needed in card
    assert "| Category KL to test rooms" in card and "real test (" in card
    if name.startswith("procthor"):
        assert "ProcTHOR" in card and "Sweet Home 3D" in card and "CC-BY-3.0" in card


def test_they_make_rooms_with_meshes(name):
    trained = load_run(SHIPPED[name])
    rooms = sample_rooms(trained, 4, 0)
    assert all(room.objects for room in rooms)
    assert all(item.mesh is not None for room in rooms for item in room.objects)
    assert all(value.dtype != torch.float16 for value in trained.prior.state_dict().values())
