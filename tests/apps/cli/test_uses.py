"""interpolate, retrieve and complete as commands: files, and sentences for what does not work."""

import errno
import json
import os

import pytest
import torch
from cli_helpers import everything_in, one_sentence
from model_folder import corner_sofa, write_models

from sceneprior.apps.config import load_run
from sceneprior.core import files
from sceneprior.paper import decode


@pytest.fixture
def rooms(command, toy_run, tmp_path):
    """Three generated rooms in `rooms/`."""
    assert command("synthesize", "--run", toy_run, "-n", 3, "--out", "rooms")[0] == 0
    return tmp_path / "rooms"


def test_empty_rooms_are_written_and_named(command, toy_run, monkeypatch):
    call = ["synthesize", "--run", toy_run, "-n", 7]
    status, _, errors = command(*call, "--out", "full")
    assert status == 0 and "empty" not in errors
    kept = decode.kept_objects

    def keep(rooms):
        """Keep the objects of some rooms only."""
        drawn = torch.zeros(7, 1, dtype=torch.bool)
        drawn[rooms] = True
        monkeypatch.setattr(
            decode, "kept_objects", lambda logits, target: kept(logits, target) & drawn
        )

    keep([0, 1, 2, 4, 5, 6])
    status, out, errors = command(*call, "--out", "one")
    assert (status, out) == (0, "Wrote 7 rooms to one (from: paper)\n")
    assert errors.strip().splitlines()[-1] == (
        "Note: 1 of 7 rooms are empty (no object): seed0_0003. Train longer, or on more rooms."
    )
    keep([])
    status, _, errors = command(*call, "--out", "none")
    assert status == 0 and errors.strip().splitlines()[-1].startswith(
        "Note: 7 of 7 rooms are empty (no object): seed0_0000, seed0_0001, seed0_0002, seed0_0003, "
        "seed0_0004 and 2 more. Train"
    )


def test_interpolate(command, toy_run, rooms, tmp_path):
    first = load_run(toy_run).room_ids[0]
    call = ["interpolate", "--run", toy_run, "--from", first]
    end = "rooms/latents.npz:seed0_0002"
    status, out, errors = command(*call, "--to", end, "--steps", 4, "--out", "way")
    assert (status, out) == (0, "Wrote 4 rooms, strip.png and animation.gif to way\n"), errors
    files = {f"step_{k:02d}.{kind}" for k in range(4) for kind in ("json", "glb", "png")}
    files |= {"overview.png", "strip.png", "animation.gif", "latents.npz"}
    assert {path.name for path in (tmp_path / "way").iterdir()} == files
    extra = json.loads((tmp_path / "way" / "step_03.json").read_text())["extra"]
    assert extra["along"] == 1 and extra["to"] == end and extra["slots"]
    before = everything_in(tmp_path)
    assert "way is not empty" in one_sentence(command(*call, "--to", "seed:1", "--out", "way"))
    assert everything_in(tmp_path) == before


def test_retrieve(command, rooms, tmp_path):
    write_models(
        tmp_path / "models",
        {
            "bed": ("King-size Bed", corner_sofa()),
            "ward": ("Wardrobe", corner_sofa()),
            "gone": ("Desk", corner_sofa()),
        },
    )
    (tmp_path / "models" / "gone" / "raw_model.obj").unlink()
    call = ["retrieve", "--scenes", "rooms", "--models", "models", "--cache", "cache"]
    status, out, errors = command(*call, "--out", "cad")
    assert status == 0, errors
    assert "1 models are broken; see retrieval.json\nWrote 3 rooms to cad\n" in out
    report = json.loads((tmp_path / "cad" / "retrieval.json").read_text())
    assert report["scenes"] == 3 and set(report["broken_models"]) == {"gone"}
    scene = json.loads((tmp_path / "cad" / "seed0_0000.json").read_text())
    for item, found in zip(scene["objects"], scene["extra"]["retrieval"], strict=True):
        models = {"double_bed": "bed", "wardrobe": "ward"}
        assert (found or {}).get("model_id") == models.get(item["class"])
    assert (tmp_path / "cad" / "overview.png").is_file()
    again = command(*call, "--out", "again")
    assert again[0] == 0
    assert everything_in(tmp_path / "cad") == everything_in(tmp_path / "again")
    said = one_sentence(command("retrieve", "--scenes", "cache", *call[3:], "--out", "new"))
    assert "cache holds no scene JSON" in said and not (tmp_path / "new").exists()


def test_complete(command, toy_run, rooms, tmp_path, monkeypatch):
    monkeypatch.setattr("sceneprior.lifted.complete.RESTARTS", 1)
    scene = json.loads((rooms / "seed0_0001.json").read_text())
    scene["objects"] = scene["objects"][:1]
    given = tmp_path / "given.json"
    given.write_text(json.dumps(scene))
    call = ["complete", "--run", toy_run, "--given", given]
    status, out, errors = command(*call, "-n", 2, "--out", "whole")
    assert (status, out) == (
        0,
        "Wrote 2 rooms around 1 given object, decoded from fitted latents, to whole\n",
    ), errors
    made = json.loads((tmp_path / "whole" / "complete_01.json").read_text())
    assert made["objects"][0] == scene["objects"][0] and made["extra"]["given"] == [0]
    assert (tmp_path / "whole" / "overview.png").is_file()
    # Answers are ends of a path, too.
    ends = ["--from", "whole/latents.npz:complete_00", "--to", "whole/latents.npz:complete_01"]
    walk = ["interpolate", "--run", toy_run, *ends, "--steps", 2, "--out", "walk"]
    assert command(*walk)[0] == 0
    said = one_sentence(command(*call[:3], "--given", "gone.json", "--out", "many"))
    assert "gone.json cannot be read (No such file or directory)" in said
    assert not (tmp_path / "many").exists()


def test_a_sampler_s_rooms_have_no_latents(command, sampler_run, tmp_path, few_attempts):
    call = ["synthesize", "--run", sampler_run, "-n", 2]
    assert command(*call, "--out", "drawn")[0] == 0
    assert command(*call, "--out", "decoded", "--distribution", "paper")[0] == 0
    assert not (tmp_path / "drawn" / "latents.npz").exists()
    assert (tmp_path / "decoded" / "latents.npz").exists()
    assert (tmp_path / "drawn" / "seed0_0001.json").exists()


def test_complete_adds_what_is_asked_for(command, sampler_run, tmp_path, few_attempts):
    empty = {
        "format": "sceneprior-scene", "version": 1, "name": "mine", "objects": [],
        "label_set": "front3d_bedroom", "floor_m": [[-2, -2], [2, -2], [2, 2], [-2, 2]],
    }  # fmt: skip
    (tmp_path / "given.json").write_text(json.dumps(empty))
    call = ["complete", "--given", "given.json", "-n", 2, "--classes", "double_bed, nightstand"]
    status, _, errors = command(*call, "--run", sampler_run, "--out", "whole")
    assert status == 0, errors
    room = json.loads((tmp_path / "whole" / "complete_00.json").read_text())
    assert sorted(item["class"] for item in room["objects"]) == ["double_bed", "nightstand"]
    # A given bed that fills the floor leaves no place for another.
    bed = {"class": "double_bed", "center_m": [0, 0.3, 0], "size_m": [1.6, 0.6, 2.0]}
    floor = [[-0.8, -1], [0.8, -1], [0.8, 1], [-0.8, 1]]
    (tmp_path / "full.json").write_text(json.dumps(empty | {"objects": [bed], "floor_m": floor}))
    full = ["complete", "--given", "full.json", "-n", 1, "--classes", "double_bed"]
    status, out, errors = command(*full, "--run", sampler_run, "--out", "full")
    assert status == 0 and out.startswith("Wrote 1 room around 1 given object,")
    assert "Note: complete_00 has no place for double_bed." in errors
    room = json.loads((tmp_path / "full" / "complete_00.json").read_text())
    assert len(room["objects"]) == 1 and room["extra"]["no_place"] == ["double_bed"]


def test_a_place_that_cannot_be_written_is_a_sentence(
    command, toy_run, toy_shards, rooms, tmp_path, monkeypatch
):
    write_models(tmp_path / "models", {"bed": ("King-size Bed", corner_sofa())})

    def refuse(*_):
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(files.os, "fsync", refuse)
    for words in (
        ("export", "rooms", "--to", "obj"),
        ("complete", "--run", toy_run, "--given", rooms / "seed0_0000.json"),
        ("interpolate", "--run", toy_run, "--from", "seed:1", "--to", "seed:2"),
        ("retrieve", "--scenes", "rooms", "--models", "models", "--cache", "cache"),
        ("reconstruct", "--run", toy_run, "--shards", toy_shards, "--split", "test"),
    ):
        said = one_sentence(command(*words, "--out", "new"))
        assert "new cannot be read or written (Read-only file system); name a folder that" in said
        assert not (tmp_path / "new").exists()
