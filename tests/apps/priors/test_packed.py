"""Packed priors: the same rooms to the bit; what is damaged or hostile is a sentence."""

import hashlib
import json
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from golden_values import assert_as_before
from refusals import refused
from safetensors.torch import load, save
from tiny_runs import tiny_baseline, tiny_config

import sceneprior
from sceneprior.apps.config import load_any_run, load_config
from sceneprior.apps.priors.packed import (
    CARD,
    CONFIG,
    FILES,
    WEIGHTS,
    pack,
    read_packed,
    write_packed,
)
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import InputError
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.lifted.requests.request import RoomRequest
from sceneprior.paper.interpolate import interpolate

pytestmark = pytest.mark.usefixtures("few_attempts")
BED = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))
CONFIGS = sorted(
    path
    for path in (Path(__file__).parents[3] / "configs").rglob("*.yaml")
    if path.parent.name != "compare"
)


def packed_file(run: Path, path: Path, **options: bool) -> Path:
    write_packed(pack(load_any_run(run), "# a card", **options), path)
    return path


@pytest.fixture(scope="module")
def sampler_file(sampler_run, tmp_path_factory) -> Path:
    return packed_file(sampler_run, tmp_path_factory.mktemp("packed") / "tiny.prior")


def assert_same(rooms: list[Scene], others: list[Scene]) -> None:
    """To the bit."""
    assert len(rooms) == len(others)
    for room, other in zip(rooms, others, strict=True):
        assert [item.label for item in room.objects] == [item.label for item in other.objects]
        np.testing.assert_array_equal(room.centers_m, other.centers_m)
        np.testing.assert_array_equal(room.sizes_m, other.sizes_m)
        for one, two in zip(room.objects, other.objects, strict=True):
            assert (one.mesh is None) == (two.mesh is None)
            if one.mesh is not None and two.mesh is not None:
                np.testing.assert_array_equal(one.mesh.vertices_m, two.mesh.vertices_m)
                np.testing.assert_array_equal(one.mesh.faces, two.mesh.faces)


def test_a_sampler_s_rooms_are_the_same_to_the_bit(sampler_run, sampler_file):
    trained, back = (
        sceneprior.load(sampler_run).with_latents,
        sceneprior.load(sampler_file).with_latents,
    )
    assert_same(sample_rooms(trained, 4, 3), sample_rooms(back, 4, 3))
    given = RoomRequest(objects=[BED])
    assert_same(*(sample_rooms(one, 2, 0, request=given) for one in (trained, back)))
    # The same point of the sphere, wherever it is drawn from.
    z = torch.randn(2, back.config.model.width, generator=torch.Generator().manual_seed(0))
    assert_same(*(interpolate(one, z[0], z[1], 3) for one in (trained, back)))


def test_without_latents_rooms_come_from_anywhere_and_are_not_remembered(sampler_run, sampler_file):
    back = sceneprior.load(sampler_file).with_latents
    assert not back.remembers_rooms and back.room_ids == () and len(back.logits) == 0
    assert (back.distribution, back.latent_distribution) == ("sampler", "paper")
    assert read_packed(sampler_file).said.training_rooms == len(
        sceneprior.load(sampler_run).with_latents.room_ids
    )
    held = sampler_file.read_bytes()
    assert not any(
        name.encode() in held for name in sceneprior.load(sampler_run).with_latents.room_ids
    )
    with pytest.raises(
        InputError, match=r"kernel .* of at least 2 training rooms, and this prior keeps 0"
    ):
        sample_rooms(back, 2, 0, "kernel")


@pytest.mark.parametrize("method", ["atiss", "sync2gen", "set_flow"])
def test_methods_of_boxes_travel_too(method, toy_shards, tmp_path):
    config = tiny_baseline(toy_shards, method).with_label_set()
    stage = config.stage_names[-1]
    trained = config.trained(config.networks(stage, 0), stage, ("a", "b"))
    write_packed(pack(trained, "# a card"), tmp_path / "a.prior")
    assert_same(sample_rooms(trained, 3, 1), sample_rooms(load_any_run(tmp_path / "a.prior"), 3, 1))


@pytest.mark.parametrize("options", [{}, {"latents": True}], ids=str)
def test_a_packed_file_has_the_same_bytes_as_before(tmp_path, options):
    """Weights are counted up, so that they do not depend on a processor."""
    config = tiny_config("some/shards").with_label_set()
    networks = config.networks("shape", 3)
    for number, tensor in enumerate(networks.state_dict().values()):
        values = torch.arange(tensor.numel()).reshape(tensor.shape) % 97 / 8 + number
        tensor.copy_(values.to(tensor.dtype))
    trained = config.trained(networks, "shape", ("a", "b", "c"))
    write_packed(pack(trained, "# a card", **options), tmp_path / "a.prior")
    with zipfile.ZipFile(tmp_path / "a.prior") as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    assert tuple(contents) == FILES
    found = {name: hashlib.sha256(content).hexdigest()[:16] for name, content in contents.items()}
    assert_as_before(f"apps/packed_{'_'.join(options) or 'plain'}", found)


def test_half_precision_is_smaller_and_nearly_the_same(
    sampler_run, sampler_file, tmp_path, monkeypatch
):
    monkeypatch.setattr("sceneprior.apps.priors.packed.FEW", 64)  # the toy's tensors are small
    small = packed_file(sampler_run, tmp_path / "half.prior", half=True)
    assert small.stat().st_size < 0.9 * sampler_file.stat().st_size
    one, other = sceneprior.load(sampler_file).with_latents, sceneprior.load(small).with_latents
    for name, value in one.prior.state_dict().items():
        found = other.prior.state_dict()[name]
        assert found.dtype == value.dtype
        torch.testing.assert_close(found, value, rtol=1e-3, atol=1e-4)


def test_the_same_prior_gives_the_same_bytes_and_a_folder_of_its_files_is_one(
    sampler_run, sampler_file, tmp_path
):
    again = packed_file(sampler_run, tmp_path / "again.prior")
    assert again.read_bytes() == sampler_file.read_bytes()
    with zipfile.ZipFile(again) as archive:
        assert tuple(archive.namelist()) == FILES
        archive.extractall(tmp_path / "folder")
    assert_same(*(sample_rooms(load_any_run(p), 2, 0) for p in (again, tmp_path / "folder")))


def test_no_path_of_the_machine_is_in_it(sampler_file, toy_shards):
    packed = read_packed(sampler_file)
    assert packed.said.settings["data"]["shards"] == toy_shards.name
    with zipfile.ZipFile(sampler_file) as archive:
        assert str(toy_shards.parent).encode() not in b"".join(map(archive.read, FILES))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_networks_have_the_same_shapes_without_memory(path):
    """`unpack` compares a file with these shapes before it builds anything."""
    config = load_config(str(path)).model_copy(update={"label_set": "front3d_bedroom"})
    stage = config.stage_names[-1]
    with torch.device("meta"):
        unbuilt = config.networks(stage, 3).state_dict()
    built = config.networks(stage, 3).state_dict()
    assert {k: v.shape for k, v in unbuilt.items()} == {k: v.shape for k, v in built.items()}
    assert {value.device.type for value in unbuilt.values()} == {"meta"}


# -- Damaged and hostile files ---------------------------------------------------------------------


def rewritten(path: Path, target: Path, **changed: bytes | None) -> Path:
    """The same file with some of its files' contents exchanged, or left out."""
    names = {"card": CARD, "config": CONFIG, "weights": WEIGHTS}
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for key, name in names.items():
            content = changed.get(key, old.read(name))
            if content is not None:
                new.writestr(name, content)
    return target


def contents(path: Path, name: str) -> bytes:
    with zipfile.ZipFile(path) as archive:
        return archive.read(name)


def assert_refused(path: Path, what: str | None = None) -> None:
    with pytest.raises(InputError, match=what) as error:
        load_any_run(path)
    assert "\n" not in str(error.value) and len(str(error.value)) > 40


def test_pickles_and_checkpoints_are_refused_unopened(sampler_run, sampler_file, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    path = tmp_path / "a.prior"
    path.write_bytes(pickle.dumps(Bomb()))
    assert_refused(path, "is not a packed prior")
    assert_refused(rewritten(sampler_file, path, weights=pickle.dumps(Bomb())))
    assert_refused(rewritten(sampler_file, path, config=pickle.dumps(Bomb())))
    shutil.copy(sampler_run / "sampler" / "final.ckpt", path)  # a zip, too
    assert_refused(path, "is not a packed prior")
    assert not (tmp_path / "ran").exists()


def test_large_files_are_refused_before_they_are_read(sampler_file, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneprior.apps.priors.packed.LARGEST", dict.fromkeys(FILES, 10_000))
    with refused("apps/prior_large", tmp=sampler_file.parent):
        load_any_run(sampler_file)


@pytest.mark.parametrize(
    ("section", "key", "value"),
    [
        ("model", "width", 2**40), ("model", "max_objects", 10**9), ("sampler", "layers", 10**9),
        ("sampler", "width", 10**9), ("model", "width", 8), ("model", "width", "wide"),
        ("model", "unknown", 1),
    ],
)  # fmt: skip
def test_settings_that_ask_for_other_networks_are_sentences(
    sampler_file, tmp_path, section, key, value
):
    data = json.loads(contents(sampler_file, CONFIG))
    data["settings"][section][key] = value
    content = json.dumps(data).encode()
    assert_refused(rewritten(sampler_file, tmp_path / "a.prior", config=content))


DESCRIPTIONS = {
    "format": {"format": "other"},
    "version": {"version": 2},
    "no_stage": {"stage": "nothing"},
    "stage_type": {"stage": ["shape"]},
    "classes": {"classes": ["void", "throne"]},
    "room_ids": {"room_ids": ["a", "b"]},
    "settings": {"settings": 3},
    "method": {"settings": {"method": "magic"}},
}


@pytest.mark.parametrize("name", DESCRIPTIONS)
def test_descriptions_that_are_wrong_say_what_is(sampler_file, tmp_path, name):
    said = json.loads(contents(sampler_file, CONFIG)) | DESCRIPTIONS[name]
    path = rewritten(sampler_file, tmp_path / "a.prior", config=json.dumps(said).encode())
    with refused(f"apps/prior_{name}", tmp=tmp_path):
        load_any_run(path)


def test_wrong_numbers_and_classes_are_refused(sampler_file, tmp_path):
    tensors = load(contents(sampler_file, WEIGHTS))
    weight = "prior.layout.mlp1.0.weight"
    label = next(name for name in tensors if name.endswith("_class"))
    changes = {
        "nan": tensors | {weight: torch.full_like(tensors[weight], torch.nan)},
        "unknown_class": tensors | {label: torch.full_like(tensors[label], 99)},
        "missing_tensor": {name: value for name, value in tensors.items() if name != label},
    }
    for name, changed in changes.items():
        path = rewritten(sampler_file, tmp_path / f"{name}.prior", weights=save(changed))
        with refused(f"apps/prior_{name}", tmp=tmp_path, label=label):
            load_any_run(path)


def test_other_zips_and_folders_are_sentences(sampler_file, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.prior", "w") as archive:
        archive.writestr("notes.txt", "hello")
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / WEIGHTS).write_bytes(b"")
    for name, path in (
        ("other_zip", tmp_path / "a.prior"),
        ("no_run", tmp_path),
        ("empty_folder", tmp_path / "folder"),
    ):
        with refused(f"apps/prior_{name}", tmp=tmp_path):
            load_any_run(path)
