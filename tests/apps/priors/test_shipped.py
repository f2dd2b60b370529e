"""The priors of the package: small, with a card, and without what must not be passed on."""

import hashlib
import json
import shutil
import sys
import zipfile
from pathlib import Path

import pytest
import torch
from golden_values import assert_as_before
from refusals import refused

import sceneprior
from sceneprior.apps.config import load_any_run
from sceneprior.apps.priors.packed import (
    FILES,
    find_prior,
    pack,
    read_packed,
    shipped_priors,
    write_packed,
)
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import InputError
from sceneprior.render.scene_files import save

SHIPPED = shipped_priors()
COMMIT = "0123456789abcdef0123456789abcdef01234567"


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
    wanted: dict[str, object] = {
        "prior": name,
        "prior_version": version,
        "sceneprior": sceneprior.__version__,
        "seed": 3,
        "distribution": "sampler",
        "request": {"floor": [[0, 0], [4, 0], [4, 3.5], [0, 3.5]], "openings": "door"},
        "wishes": [
            {"wish": "door", "holds": True},
            {"wish": "all on the floor of 4 x 3.5 m", "holds": True},
        ],
    }
    wanted["remarks"] = room.extra.get("remarks")
    assert room.extra == wanted and isinstance(wanted["remarks"], list)
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


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def test_shipped_priors_hold_the_same_weights():
    """Whatever the names of tensors, which may change."""
    found = {}
    for name, path in shipped_priors().items():
        trained, said = load_any_run(name), read_packed(path).said
        networks = {"prior": trained.prior, "sampler": trained.sampler}
        tensors = [t for n in networks.values() for t in n.state_dict().values()]
        hashes = sorted(
            _digest(t.contiguous().numpy().tobytes()) for t in [*tensors, trained.logits]
        )
        found[name] = [trained.stage, said.training_rooms, len(said.room_ids), len(hashes),
                       _digest("".join(hashes).encode())]  # fmt: skip
    assert_as_before("apps/shipped_weights", found)


# -- Finding them ----------------------------------------------------------------------------------


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """A cache of the Hub without a network, which holds nothing yet."""
    constants = pytest.importorskip("huggingface_hub.constants")
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    return tmp_path / "cache"


def test_a_repository_of_the_hub_is_a_prior(hub, sampler_run, tmp_path, few_attempts):
    """The repository is stored as the Hub's own client does: by commit, with the name of the
    branch."""
    trained = load_any_run(sampler_run)
    write_packed(pack(trained, "# a card"), tmp_path / "a.prior")
    repository = hub / "models--someone--bedrooms"
    with zipfile.ZipFile(tmp_path / "a.prior") as archive:
        archive.extractall(repository / "snapshots" / COMMIT)
    (repository / "refs").mkdir()
    (repository / "refs" / "main").write_text(COMMIT)
    found = find_prior("hf://someone/bedrooms")
    assert {path.name for path in found.iterdir()} == set(FILES)
    one, other = (
        [item.center_m for room in sample_rooms(run, 8, 0) for item in room.objects]
        for run in (trained, load_any_run("hf://someone/bedrooms"))
    )
    assert one == other and one


def test_what_the_hub_does_not_give_is_one_sentence(hub):
    for name in ("hf://someone/else", "hf://", "hf://a/b/c", "hf://no spaces/here"):
        with pytest.raises(InputError) as error:
            find_prior(name)
        assert str(error.value).startswith(f"{name} cannot be fetched (")
        assert "\n" not in str(error.value) and "HF_TOKEN" in str(error.value)


def test_without_the_hub_s_client_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "huggingface_hub", None)
    with refused("apps/prior_no_hub"):
        find_prior("hf://someone/bedrooms")


def test_paths_come_before_names(tmp_path, monkeypatch):
    name = next(iter(shipped_priors()))
    assert find_prior(name) == shipped_priors()[name]
    monkeypatch.chdir(tmp_path)
    shutil.copy(shipped_priors()[name], tmp_path / name)
    assert find_prior(name) == Path(name)
    with refused("apps/prior_missing"):
        find_prior("nothing")
