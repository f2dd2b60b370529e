"""pack and priors as commands, and packed priors wherever a run may stand."""

import json
import os
import shutil
from pathlib import Path

import pytest
from cli_helpers import one_sentence
from toy_metrics import without_classifiers

from sceneprior.apps.config import load_any_run
from sceneprior.apps.priors.packed import shipped_priors
from sceneprior.apps.rooms import write_scenes
from sceneprior.core.scene import Scene, SceneObject
from sceneprior.interchange.export import FORMATS

BEDROOM = "front3d_bedroom"


@pytest.fixture
def packed(command, sampler_run, tmp_path):
    """A packed prior at `mine.prior`."""
    (tmp_path / "about.md").write_text("Toys, made by hand; CC0.\n")
    status, out, errors = command("pack", sampler_run, "--out", "mine.prior", "--about", "about.md")
    assert (status, errors) == (0, "") and out.startswith("Wrote mine.prior (0.")
    return tmp_path / "mine.prior"


def test_scores_of_a_packed_prior_need_a_file_and_shards(
    command, packed, toy_shards, tmp_path, monkeypatch, few_attempts
):
    without_classifiers(monkeypatch)
    assert "mine.prior is not a folder, so scores.json cannot go there" in one_sentence(
        command("eval-fid", "--run", "mine.prior", "-n", 3)
    )
    call = ["eval-fid", "--run", "procthor-bedroom", "-n", 3, "--out", "s.json"]
    assert "procthor-bedroom was trained on shards 'front_bedroom_large', which do not" in (
        one_sentence(command(*call))
    )
    call = ["eval-fid", "--run", "mine.prior", "-n", 3, "--resamples", 0, "--out", "s.json"]
    status, _, errors = command(*call, "--shards", toy_shards)
    assert status == 0, errors
    assert json.loads((tmp_path / "s.json").read_text())["protocol"]["run"] == "mine.prior"
    said = one_sentence(
        command("eval-svr", "--run", "mine.prior", "--shards", toy_shards, "--out", "svr.json")
    )
    assert "this prior was packed without them; take the run that it was packed from" in said
    assert "`demo-bedroom`" in said and len(load_any_run("demo-bedroom").logits) > 1


def test_pack_does_not_write_over_unasked_and_says_what_is_missing(
    command, packed, sampler_run, toy_run, tmp_path
):
    call = ["pack", sampler_run, "--out", "mine.prior"]
    assert "mine.prior already exists; name another file" in one_sentence(command(*call))
    status, _, errors = command(*call, "--overwrite")
    assert status == 0 and "does not state the data's authors and licence" in errors
    call = ["pack", sampler_run, "--out", "b.prior", "--about"]
    os.mkfifo("pipe")
    for about in ("absent.md", "/dev/zero", "pipe"):
        assert f"{about} cannot be read: it is missing or not" in one_sentence(
            command(*call, about)
        )
    Path("long.md").write_text("x" * 2**21)
    assert "README.md of b.prior would have" in one_sentence(command(*call, "long.md"))
    assert "packed priors are not run folders" in one_sentence(
        command("pack", "mine.prior", "--out", "b.prior")
    )
    assert not Path("b.prior").exists()
    _, _, errors = command("pack", toy_run, "--out", "c.prior")
    assert "needs --latents" not in errors  # its rooms are drawn by `paper`
    run = shutil.copytree(toy_run, tmp_path / "run")
    config = run / "config.yaml"
    config.write_text(config.read_text().replace("distribution: paper", "distribution: kernel"))
    _, _, errors = command("pack", run, "--out", "d.prior")
    assert "draws rooms from 'kernel', which needs --latents" in errors
    _, _, errors = command("pack", run, "--out", "e.prior", "--latents")
    assert "needs --latents" not in errors


def test_priors_are_listed_and_their_cards_printed(command, packed, sampler_run):
    status, out, _ = command("priors")
    assert status == 0
    assert [line.split()[0] for line in out.splitlines()] == list(shipped_priors())
    status, out, _ = command("priors", "mine.prior")
    assert status == 0 and "# mine\n" in out and "Toys, made by hand; CC0." in out
    assert "is a run, which has no card" in one_sentence(command("priors", sampler_run))


def test_export_goes_both_ways(command, tmp_path):
    bed = SceneObject("double_bed", (0.2, 0.3, -0.9), (1.7, 0.6, 2.1))
    rooms = [Scene(name, BEDROOM, (bed,)) for name in ("first", "second")]
    write_scenes(rooms, tmp_path / "rooms")
    for to in FORMATS:
        status, out, errors = command("export", "rooms", "--to", to, "--out", to)
        assert (status, out) == (0, f"Wrote 2 rooms to {to}\n"), errors
    back = ["export", "atiss", "--to", "scenes", "--out", "back"]
    assert "needs --label-set" in one_sentence(command(*back))
    assert command(*back, "--label-set", BEDROOM)[0] == 0
    assert {path.name for path in (tmp_path / "back").glob("*.json")} == {
        "first.json", "second.json",
    }  # fmt: skip
    assert "atiss is not empty" in one_sentence(
        command("export", "rooms", "--to", "atiss", "--out", "atiss")
    )
    assert "apply only with --to scenes" in one_sentence(
        command("export", "rooms", "--to", "obj", "--out", "x", "--label-set", BEDROOM)
    )
