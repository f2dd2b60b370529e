"""Commands that make rooms, and share them: the files that they write, and their notes."""

import json
import os
import re
import shutil
from pathlib import Path

import pytest
import torch
import trimesh
from cli_helpers import everything_in, one_sentence
from model_folder import corner_sofa, write_models

from sceneprior.apps import api
from sceneprior.apps.api import load
from sceneprior.apps.priors.packed import shipped_priors
from sceneprior.apps.rooms import write_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.interchange.export import FORMATS
from sceneprior.lifted.drawing import draw
from sceneprior.paper import sampling

BEDROOM = "front3d_bedroom"


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


@pytest.fixture
def rooms(command, toy_run, tmp_path):
    """Three generated rooms in `rooms/`."""
    assert command("synthesize", "--run", toy_run, "-n", 3, "--out", "rooms")[0] == 0
    return tmp_path / "rooms"


def test_a_refused_request_keeps_the_old_rooms(command, sampler_run, tmp_path):
    call = ["synthesize", "--run", sampler_run, "-n", "2", "--out", "made", "--overwrite"]
    assert command(*call)[0] == 0
    before = everything_in(tmp_path / "made")
    assert command(*call, "--floor", "0.5x0.5", "--want", "9 sofas")[0] == 2
    assert everything_in(tmp_path / "made") == before


def test_rooms_that_lack_something_are_kept_and_counted(command, tmp_path, monkeypatch):
    monkeypatch.setattr(draw, "REQUESTED", draw.REQUESTED._replace(attempts=3, whole=1, sound=1))
    want = "double_bed: 1, desk: 1, single_bed: 1"
    call = [
        "synthesize",
        "--run",
        "procthor-bedroom",
        "-n",
        8,
        "--floor",
        "2.4x2.4",
        "--want",
        want,
    ]
    found = []
    for size in (2, 64):  # no room of the first task holds the request
        monkeypatch.setattr(api, "BATCH", size)
        status, out, errors = command(*call, "--out", f"by{size}")
        assert status == 3 and out.endswith(f"Wrote 8 rooms to by{size} (from: sampler)\n")
        paths = sorted((tmp_path / f"by{size}").glob("*.json"))
        rooms = [json.loads(path.read_text()) for path in paths]
        lacks = [room["extra"].pop("lacks", "") for room in rooms]
        assert len(rooms) == 8 and all(lacks[:2]) and "" in lacks[2:]
        for room, said in zip(rooms, lacks, strict=True):
            assert all(each["holds"] for each in room["extra"]["wishes"][:3]) == (not said)
        said = f"Note: {8 - lacks.count('')} of 8 rooms could not be drawn as requested: {lacks[0]}"
        assert errors.splitlines()[-1] == said and "desk found no place; most" in said
        found.append(rooms)
    assert found[0] == found[1]


def test_synthesize_writes_rooms_and_the_same_again(command, toy_run, tmp_path):
    call = ["synthesize", "--run", toy_run, "-n", "3", "--seed", "5", "--shell", "walls"]
    status, out, _ = command(*call, "--out", "made")
    assert (status, out) == (0, "Wrote 3 rooms to made (from: paper)\n")
    names = {f"seed5_000{k}.{kind}" for k in range(3) for kind in ("json", "glb", "png")}
    assert names_in(tmp_path / "made") == names | {"overview.png", "latents.npz"}
    scene = json.loads((tmp_path / "made" / "seed5_0000.json").read_text())
    assert scene["label_set"] == BEDROOM and scene["units"] == "metres"
    nodes = trimesh.load_scene(tmp_path / "made" / "seed5_0000.glb").graph.nodes_geometry
    assert {"floor", "wall_0", "ceiling"} <= set(nodes)
    before = everything_in(tmp_path)
    assert command(*call, "--out", "made", "--overwrite", "--html")[0] == 0
    page = (tmp_path / "made" / "rooms.html").read_text()
    assert page.count("<model-viewer ") == 3 and "seed 5 · from: paper" in page
    assert command(*call, "--out", "made", "--overwrite")[0] == 0
    assert everything_in(tmp_path) == before


@pytest.mark.parametrize(
    ("furnished", "note"),
    [
        ([0, 1, 2, 4, 5, 6], "1 of 7 rooms are empty (no object): seed0_0003."),
        ([], f"7 of 7 rooms are empty (no object): {', '.join(f'seed0_000{k}' for k in range(5))} "
         "and 2 more."),
    ],
)  # fmt: skip
def test_empty_rooms_are_written_and_named(command, toy_run, monkeypatch, furnished, note):
    drawn = torch.zeros(7, 1, dtype=torch.bool)
    drawn[furnished] = True
    kept = sampling.kept_objects
    monkeypatch.setattr(sampling, "kept_objects", lambda *given: kept(*given) & drawn)
    status, out, errors = command("synthesize", "--run", toy_run, "-n", 7, "--out", "some")
    assert (status, out) == (0, "Wrote 7 rooms to some (from: paper)\n")
    last = errors.strip().splitlines()[-1]
    assert last == f"Note: {note} Train longer, or on more rooms."


def test_interpolate(command, toy_run, rooms, tmp_path):
    first = load(toy_run).with_latents.room_ids[0]
    end = "rooms/latents.npz:seed0_0002"
    call = ["interpolate", "--run", toy_run, "--from", first, "--to", end]
    status, out, errors = command(*call, "--steps", 4, "--out", "way")
    assert (status, out) == (0, "Wrote 4 rooms, strip.png and animation.gif to way\n"), errors
    extra = json.loads((tmp_path / "way" / "step_03.json").read_text())["extra"]
    assert extra["along"] == 1 and extra["to"] == end and extra["slots"]


def test_retrieve(command, rooms, tmp_path):
    models = {"bed": "King-size Bed", "ward": "Wardrobe", "gone": "Desk"}
    made = {key: (label, corner_sofa()) for key, label in models.items()}
    write_models(tmp_path / "models", made)
    (tmp_path / "models" / "gone" / "raw_model.obj").unlink()
    call = ["retrieve", "--scenes", "rooms", "--models", "models", "--cache", "cache"]
    status, out, errors = command(*call, "--out", "cad")
    assert status == 0, errors
    assert "1 models are broken; see retrieval.json\nWrote 3 rooms to cad\n" in out
    report = json.loads((tmp_path / "cad" / "retrieval.json").read_text())
    assert report["scenes"] == 3 and set(report["broken_models"]) == {"gone"}
    scene = json.loads((tmp_path / "cad" / "seed0_0000.json").read_text())
    for item, found in zip(scene["objects"], scene["extra"]["retrieval"], strict=True):
        known = {"double_bed": "bed", "wardrobe": "ward"}
        assert (found or {}).get("model_id") == known.get(item["class"])
    assert command(*call, "--out", "again")[0] == 0
    assert everything_in(tmp_path / "cad") == everything_in(tmp_path / "again")


def test_complete_adds_what_is_asked_for(command, sampler_run, tmp_path, few_attempts):
    empty = {
        "format": "sceneprior-scene", "version": 1, "name": "mine", "objects": [],
        "label_set": BEDROOM, "floor_m": [[-2, -2], [2, -2], [2, 2], [-2, 2]],
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
    assert status == 0 and out.startswith("Wrote 1 room around 1 given object to")
    assert "Note: complete_00 has no place for double_bed." in errors
    room = json.loads((tmp_path / "full" / "complete_00.json").read_text())
    assert len(room["objects"]) == 1 and room["extra"]["no_place"] == ["double_bed"]


# -- Packed priors, which stand wherever a run may stand, and exports ------------------------------


@pytest.fixture
def packed(command, sampler_run, tmp_path):
    """A packed prior at `mine.prior`."""
    (tmp_path / "about.md").write_text("Toys, made by hand; CC0.\n")
    status, out, errors = command("pack", sampler_run, "--out", "mine.prior", "--about", "about.md")
    assert (status, errors) == (0, "") and out.startswith("Wrote mine.prior (0.")
    return tmp_path / "mine.prior"


def test_a_packed_prior_stands_for_a_run(command, packed, tmp_path, few_attempts):
    assert command("synthesize", "--run", "mine.prior", "-n", 2, "--out", "drawn")[0] == 0
    made = tmp_path / "drawn"
    assert (made / "seed0_0001.json").exists() and not (made / "latents.npz").exists()


def test_pack_says_what_is_missing(command, sampler_run, toy_run, tmp_path):
    status, _, errors = command("pack", sampler_run, "--out", "b.prior")
    assert status == 0 and "does not state the data's authors and licence" in errors
    call = ["pack", sampler_run, "--out", "b.prior", "--overwrite", "--about"]
    os.mkfifo("pipe")
    assert "pipe cannot be read (" in one_sentence(command(*call, "pipe"))
    run = shutil.copytree(toy_run, tmp_path / "run")
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("distribution: paper", "distribution: kernel"))
    _, _, errors = command("pack", run, "--out", "d.prior")
    assert "draws rooms from 'kernel', which needs --latents" in errors
    _, _, errors = command("pack", run, "--out", "e.prior", "--latents")
    assert "needs --latents" not in errors


def test_priors_are_listed_and_their_cards_printed(command, packed):
    status, out, _ = command("priors")
    assert status == 0
    *parts, _ = out.split("\n\n")
    assert [part.split()[0] for part in parts] == list(shipped_priors())
    for part in parts:
        lines = dict(line.strip().split(": ", 1) for line in part.splitlines()[1:])
        assert list(lines) == ["rooms", "trained on", "classes", "scores", "licence"]
        assert re.search(r"near copies 0\.(000|\d+ \(0\.\d+ to 0\.\d+\))", lines["scores"])
        assert "MIT" in lines["licence"] or "CC-BY" in lines["licence"]
        low, high = map(int, re.findall(r"\d+", lines["rooms"]))
        assert 4 < low < high < 100
    status, out, _ = command("priors", "mine.prior")
    assert status == 0 and "# mine\n" in out and "Toys, made by hand; CC0." in out


def test_export_goes_both_ways(command, tmp_path):
    bed = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))
    write_scenes([Scene(name, BEDROOM, (bed,)) for name in ("first", "second")], tmp_path / "rooms")
    for to in FORMATS:
        status, out, errors = command("export", "rooms", "--to", to, "--out", to)
        assert (status, out) == (0, f"Wrote 2 rooms to {to}\n"), errors
    back = ["export", "atiss", "--to", "scenes", "--out", "back", "--label-set", BEDROOM]
    assert command(*back)[0] == 0
    assert {path.stem for path in (tmp_path / "back").glob("*.json")} == {"first", "second"}


def test_converted_box_lists_have_walls_if_asked_for(command, tmp_path):
    bed = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))
    write_scenes([Scene("room", BEDROOM, (bed,))], tmp_path / "rooms")
    assert command("export", "rooms", "--to", "atiss", "--out", "atiss")[0] == 0
    back = ["export", "atiss", "--to", "scenes", "--out", "back", "--label-set", BEDROOM]
    assert command(*back, "--shell", "walls")[0] == 0
    nodes = trimesh.load_scene(tmp_path / "back" / "room.glb").graph.nodes_geometry
    assert {"floor", "wall_0", "wall_3"} <= set(nodes)


def test_a_strict_export_without_an_object_has_status_3(command, tmp_path):
    void = SceneObject("void", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))
    write_scenes([Scene("room", BEDROOM, (void,))], tmp_path / "rooms")
    call = ["export", "rooms", "--to", "atiss", "--out", "out", "--overwrite"]
    note = "Note: Objects of class void are left out (1): atiss has no such class.\n"
    assert command(*call)[::2] == (0, note)
    assert command(*call, "--strict")[::2] == (3, note)
