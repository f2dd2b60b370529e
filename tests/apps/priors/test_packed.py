"""Packed priors: the same rooms to the bit; what is damaged or hostile is a sentence."""

import io
import json
import pickle
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load, save
from tiny_runs import tiny_baseline

from sceneprior.apps.config import load_any_run, load_config, load_run
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
from sceneprior.lifted.complete import complete
from sceneprior.paper.interpolate import interpolate
from sceneprior.training.fit import fit

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
    trained, back = load_run(sampler_run), load_run(sampler_file)
    assert_same(sample_rooms(trained, 4, 3), sample_rooms(back, 4, 3))
    given = Scene("mine", "front3d_bedroom", (BED,))
    assert_same(*(complete(one, [given], count=2)[0] for one in (trained, back)))
    # The same point of the sphere, wherever it is drawn from.
    z = torch.randn(2, back.config.model.width, generator=torch.Generator().manual_seed(0))
    assert_same(*(interpolate(one, z[0], z[1], 3) for one in (trained, back)))


def test_without_latents_rooms_come_from_anywhere_and_are_not_remembered(sampler_run, sampler_file):
    back = load_run(sampler_file)
    assert not back.remembers_rooms and back.room_ids == () and len(back.logits) == 0
    assert (back.distribution, back.latent_distribution) == ("sampler", "paper")
    assert read_packed(sampler_file).said.training_rooms == len(load_run(sampler_run).room_ids)
    held = sampler_file.read_bytes()
    assert not any(name.encode() in held for name in load_run(sampler_run).room_ids)
    with pytest.raises(
        InputError, match=r"kernel .* of at least 2 training rooms, and this prior keeps 0"
    ):
        sample_rooms(back, 2, 0, "kernel")


def test_with_latents_it_is_the_run_itself(toy_run, tmp_path):
    path = packed_file(toy_run, tmp_path / "a.prior", latents=True)
    trained, back = load_run(toy_run), load_run(path)
    assert back.room_ids == trained.room_ids and back.stage == "shape"
    assert torch.equal(back.logits, trained.logits)
    assert_same(sample_rooms(trained, 3, 1), sample_rooms(back, 3, 1))


@pytest.mark.parametrize("method", ["atiss", "sync2gen", "set_flow"])
def test_methods_of_boxes_travel_too(method, toy_shards, tmp_path):
    config = tiny_baseline(toy_shards, method)
    fit(config, tmp_path / "run", trainer_options={"accelerator": "cpu"})
    back = load_any_run(packed_file(tmp_path / "run", tmp_path / "a.prior"))
    assert_same(sample_rooms(load_any_run(tmp_path / "run"), 3, 1), sample_rooms(back, 3, 1))


def test_half_precision_is_smaller_and_nearly_the_same(
    sampler_run, sampler_file, tmp_path, monkeypatch
):
    monkeypatch.setattr("sceneprior.apps.priors.packed.FEW", 64)  # the toy's tensors are small
    small = packed_file(sampler_run, tmp_path / "half.prior", half=True)
    assert small.stat().st_size < 0.9 * sampler_file.stat().st_size
    one, other = load_run(sampler_file), load_run(small)
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


def refused(path: Path) -> str:
    with pytest.raises(InputError) as error:
        load_any_run(path)
    assert "\n" not in str(error.value) and len(str(error.value)) > 40
    return str(error.value)


def rewritten(path: Path, target: Path, **changed: bytes | None) -> Path:
    """The same file with some of its files' contents exchanged, or left out."""
    names = {"card": CARD, "config": CONFIG, "weights": WEIGHTS}
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(target, "w") as new:
        for key, name in names.items():
            content = changed.get(key, old.read(name))
            if content is not None:
                new.writestr(name, content)
    return target


def described(path: Path) -> dict:
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read(CONFIG))


def tensors_of(path: Path) -> dict[str, torch.Tensor]:
    with zipfile.ZipFile(path) as archive:
        return load(archive.read(WEIGHTS))


def test_pickles_and_checkpoints_are_refused_unopened(sampler_run, sampler_file, tmp_path):
    class Bomb:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "ran",))

    path = tmp_path / "a.prior"
    path.write_bytes(pickle.dumps(Bomb()))
    assert "is not a packed prior" in refused(path)
    refused(rewritten(sampler_file, path, weights=pickle.dumps(Bomb())))
    refused(rewritten(sampler_file, path, config=pickle.dumps(Bomb())))
    shutil.copy(sampler_run / "sampler" / "final.ckpt", path)  # a zip, too
    assert "is not a packed prior" in refused(path)
    assert not (tmp_path / "ran").exists()


def test_what_claims_to_be_huge_is_refused_before_it_is_read(sampler_file, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneprior.apps.priors.packed.LARGEST", {n: 10_000 for n in FILES})
    assert "model.safetensors has more than 10000 bytes" in refused(sampler_file)


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
    data = described(sampler_file)
    data["settings"][section][key] = value
    content = json.dumps(data).encode()
    refused(rewritten(sampler_file, tmp_path / "a.prior", config=content))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"format": "other"}, "it says format 'other' version 1, not 'sceneprior-prior'"),
        ({"version": 2}, "version 2, not 'sceneprior-prior' version 1"),
        ({"stage": "nothing"}, "no stage of its method is called 'nothing'"),
        ({"stage": "shape"}, "its weights do not match its settings"),
        ({"stage": ["shape"]}, "'stage': input should be a valid string"),
        ({"classes": ["void", "throne"]}, "its classes are not those of front3d_bedroom"),
        ({"room_ids": ["a", "b"]}, "latents.weight and 0 others do not fit"),
        ({"settings": 3}, "'settings': input should be a valid dictionary"),
        ({"settings": {"method": "magic"}}, "no method is called 'magic'"),
    ],
)
def test_descriptions_that_are_wrong_say_what_is(sampler_file, tmp_path, change, sentence):
    content = json.dumps(described(sampler_file) | change).encode()
    path = rewritten(sampler_file, tmp_path / "a.prior", config=content)
    assert sentence in refused(path)


def test_numbers_that_are_none_and_classes_that_are_not_there(sampler_file, tmp_path):
    tensors = tensors_of(sampler_file)
    name = "prior.layout.mlp1.0.weight"
    broken = tensors | {name: torch.full_like(tensors[name], torch.nan)}
    path = rewritten(sampler_file, tmp_path / "a.prior", weights=save(broken))
    assert f"{name} holds numbers that are not finite" in refused(path)
    name = "sampler.look_class"
    broken = tensors | {name: torch.full_like(tensors[name], 99)}
    path = rewritten(sampler_file, tmp_path / "b.prior", weights=save(broken))
    assert f"{name} holds class indices out of range" in refused(path)
    del tensors[name]
    path = rewritten(sampler_file, tmp_path / "c.prior", weights=save(tensors))
    assert "sampler.look_class and 0 others do not fit" in refused(path)


def test_other_zips_and_folders_are_sentences(sampler_file, tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("notes.txt", "hello")
    (tmp_path / "a.prior").write_bytes(buffer.getvalue())
    assert "no item named 'README.md'" in refused(tmp_path / "a.prior")
    assert "is not a run folder" in refused(tmp_path)
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / WEIGHTS).write_bytes(b"")
    assert "is not a packed prior" in refused(tmp_path / "folder")
