"""The priors of the package: small, with a card, and without what must not be passed on."""

import hashlib
import json
import zipfile

import pytest
import torch

import sceneprior
from sceneprior.apps.priors.packed import FILES, read_packed, shipped_priors
from sceneprior.core.errors import InputError
from sceneprior.render.scene_files import save

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


def test_without_latents_a_sentence_names_a_prior_that_has_them(name):
    """`demo-bedroom` holds latents; the priors of ProcTHOR's rooms deliberately hold none."""
    prior = sceneprior.load(name)
    if name == "demo-bedroom":
        room_id = prior.trained.room_ids[0]
        way = prior.interpolate(room_id, "seed:1", 2)
        assert way[0].extra["from"] == room_id and way[0].extra["prior"] == "demo-bedroom"
        return
    with pytest.raises(InputError, match=r"packed without.*`demo-bedroom`, which comes with"):
        prior.interpolate("house_0001/Bedroom-1", "seed:1", 2)
    with pytest.raises(InputError, match=r"needs the latents of.*`demo-bedroom`, which comes with"):
        prior.interpolate("kernel:1", "seed:1", 2)
    with pytest.raises(InputError, match=r"packed without.*`demo-bedroom`, which comes with"):
        prior.reconstruct([], "objects")
    with pytest.raises(InputError, match=r"packed without.*`demo-bedroom`, which comes with"):
        prior.reconstruct([], "paper")


def test_rooms_say_which_prior_made_them(name, tmp_path):
    """Read back from the JSON, and in the GLB."""
    prior = sceneprior.load(name)
    (room,) = prior.sample(seed=3, floor=[[0, 0], [4, 0], [4, 3.5], [0, 3.5]], openings="door")
    assert room.objects and all(item.mesh is not None for item in room.objects)
    weights = prior.trained.prior.state_dict().values()
    assert all(value.dtype != torch.float16 for value in weights)
    version = hashlib.sha256(SHIPPED[name].read_bytes()).hexdigest()[:12]
    wanted = {
        "prior": name,
        "prior_version": version,
        "sceneprior": sceneprior.__version__,
        "seed": 3,
        "distribution": "sampler",
        "request": {"floor": [[0, 0], [4, 0], [4, 3.5], [0, 3.5]], "openings": "door"},
        "wishes": [],
    }
    assert room.extra == wanted
    for ending in ("json", "glb"):
        save(room, tmp_path / f"room.{ending}")
    read = sceneprior.load_scene(tmp_path / "room.json")
    assert read.extra == wanted
    assert [item.turned.yaw_rad for item in read.objects] == pytest.approx(
        [item.turned.yaw_rad for item in room.objects], abs=1e-6
    )
    data = (tmp_path / "room.glb").read_bytes()
    told = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    told = told["scenes"][0]["extras"]["sceneprior"]
    assert told["extra"] == wanted
    assert [each["yaw_rad"] for each in told["objects"]] == pytest.approx(
        [item.turned.yaw_rad for item in room.objects], abs=1e-6
    )


def test_their_cards_credit_the_data_and_say_how_they_were_made_and_how_good_they_are(name):
    card = read_packed(SHIPPED[name]).card
    assert SHIPPED[name].with_suffix(".md").read_text() == card  # for readers of the repository
    for needed in ("## Data, authors and licence", "sceneprior pack", "seed 0", "## Limits"):
        assert needed in card
    assert "| Category KL to test rooms" in card and "real test (" in card
    if name.startswith("procthor"):
        assert "ProcTHOR" in card and "Sweet Home 3D" in card and "CC-BY-3.0" in card
