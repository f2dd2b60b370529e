"""eval-fid from the command line: a run, the user's scenes, kept references, refusals."""

import json
import shutil
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest

from sceneprior import cli
from sceneprior.config import load_run
from sceneprior.data.dataset import allowed_views
from sceneprior.errors import InputError
from sceneprior.evaluation.ground_truth import reference_scenes
from sceneprior.evaluation.metrics.contents import class_frequencies, frequency_kl
from sceneprior.experiments.evaluate_views import mask_scores
from sceneprior.generation.decode import synthesize
from sceneprior.generation.export import write_scenes
from sceneprior.offscreen import SoftwareRenderer
from sceneprior.shards import iterate_rooms


@pytest.fixture
def command(monkeypatch, capsys, tmp_path):
    """Run `sceneprior <arguments>` in this process: (exit status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["sceneprior", *map(str, arguments)])
        capsys.readouterr()
        with pytest.raises(SystemExit) as end:
            cli.main()
        output = capsys.readouterr()
        return int(end.value.code or 0), output.out, output.err

    return run


@pytest.fixture(scope="module")
def scenes(toy_shards, tmp_path_factory):
    """Four training rooms as boxes, as another method might write them."""
    folder = tmp_path_factory.mktemp("theirs") / "scenes"
    rooms = reference_scenes(toy_shards, "train", limit=4)
    plain = [replace(room.without_meshes(), name=f"room_{k}") for k, room in enumerate(rooms)]
    write_scenes(plain, folder, SoftwareRenderer())
    return folder


def test_the_users_scenes_are_evaluated_and_again_with_the_reference(
    command, scenes, toy_shards, tmp_path
):
    call = ["eval-fid", "--scenes", scenes, "--shards", toy_shards, "--renderer", "software"]
    status, out, errors = command(*call, "--resamples", 20, "--reference", "reference.npz")
    assert status == 0, errors
    assert f"Wrote {scenes / 'scores.json'}" in out.replace("\n", "") and "4 rooms" in out
    first = json.loads((scenes / "scores.json").read_text())
    assert first["protocol"]["scenes"] == "scenes" and first["protocol"]["resamples"] == 20
    assert first["near_copy_share"] == 1 and first["out_of_bounds_share"] == 0
    # scores.json lies among the scenes now, and is none.
    status, _, errors = command(
        *call, "--resamples", 20, "--reference", "reference.npz", "--out", "b.json"
    )
    assert status == 0, errors
    assert json.loads((tmp_path / "b.json").read_text()) == first
    status, _, errors = command(*call, "-n", 2, "--seed", 3, "--resamples", 0, "--out", "c.json")
    assert status == 0, errors
    protocol = json.loads((tmp_path / "c.json").read_text())["protocol"]
    assert (protocol["n_generated"], protocol["n_scenes_available"]) == (2, 4)


def test_a_run_is_evaluated_with_its_own_shards(command, toy_run, tmp_path):
    call = ["eval-fid", "--run", toy_run, "-n", 5, "--renderer", "software", "--out", "s.json"]
    status, out, errors = command(*call, "--resamples", 5)
    assert status == 0, errors
    assert "5 rooms" in out and "nan" not in out.lower()
    scores = json.loads((tmp_path / "s.json").read_text())
    assert scores["protocol"]["latents"] == "kernel, near training rooms" and scores["rooms"] == 12
    assert "latents kernel, near training rooms" in " ".join(out.split())
    assert scores["near_copy_share"] * 5 == round(scores["near_copy_share"] * 5)
    assert np.isfinite([value for value in scores.values() if isinstance(value, float)]).all()


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ([], "There is nothing to evaluate; give --run RUN, or --scenes DIR with --shards SHARDS."),
        (["--run", "a", "--scenes", "b"], "Both --run and --scenes came; give --run"),
        (["--scenes", "b"], "--scenes needs --shards: the folder with the test rooms."),
        (
            ["--scenes", "b", "--shards", "c", "--distribution", "paper"],
            "--distribution and --checkpoint belong to",
        ),
        (["--scenes", "b", "--shards", "c"], "No folder of scenes at b;"),
        (["--run", "a"], "No prior at a;"),
        (
            ["--run", "a", "--split", "train"],
            "Generated rooms are compared with the split test, or",
        ),
    ],
)
def test_what_cannot_be_evaluated_is_one_sentence(command, tmp_path, arguments, sentence):
    status, _, errors = command("eval-fid", *arguments, "--renderer", "software")
    assert status == 2 and errors.startswith(f"Error: {sentence}"), errors
    assert len(errors.strip().splitlines()) == 1 and list(tmp_path.iterdir()) == []


def test_files_of_weights_and_references_are_checked_before_drawing(
    command, scenes, toy_shards, tmp_path
):
    call = ["eval-fid", "--scenes", scenes, "--shards", toy_shards, "--renderer", "software"]
    for option in ("--inception", "--alexnet"):
        status, _, errors = command(*call, option, "absent.pt")
        assert status == 2 and "at absent.pt" in errors and errors.count("\n") == 1
    (tmp_path / "kept.npz").write_text("no")
    status, _, errors = command(*call, "--reference", "kept.npz")
    assert status == 2 and "kept.npz is no reference" in errors


def test_boxes_are_converted_and_then_evaluated(command, toy_shards, tmp_path):
    rng = np.random.default_rng(0)
    for row in range(3):
        np.savez(
            tmp_path / f"{row}.npz",
            class_labels=np.eye(23)[[8, 12]], translations=rng.uniform(0.5, 1, (2, 3)),
            sizes=np.full((2, 3), 0.4), angles=rng.uniform(-3, 3, (2, 1)),
        )  # fmt: skip
    (tmp_path / "theirs").mkdir()
    for path in tmp_path.glob("*.npz"):
        path.rename(tmp_path / "theirs" / path.name)
    call = ["export", "theirs", "--to", "scenes", "--out", "ours", "--label-set", "front3d_bedroom"]
    assert command(*call)[:2] == (0, "Wrote 3 rooms to ours\n")
    status, _, errors = command(*call)
    assert status == 2 and "ours is not empty; add --overwrite" in errors
    status, _, errors = command(
        "eval-fid", "--scenes", "ours", "--shards", toy_shards, "--resamples", 0,
        "--renderer", "software",
    )  # fmt: skip
    assert status == 0, errors
    scores = json.loads((tmp_path / "ours" / "scores.json").read_text())
    assert scores["mean_objects"] == 2 and scores["out_of_bounds_share"] is None


def test_a_run_without_3d_truth_has_a_page_and_scores_from_views(
    command, toy_shards, toy_run, tmp_path
):
    shutil.copytree(toy_shards, tmp_path / "bare")
    for path in (tmp_path / "bare").glob("*/*.h5"):
        with h5py.File(path, "a") as file:
            for group in file["rooms"].values():
                del group["ground_truth"]
    shutil.copytree(toy_run, tmp_path / "run")
    config = tmp_path / "run" / "config.yaml"
    config.write_text(config.read_text().replace(str(toy_shards), str(tmp_path / "bare")))
    status, _, errors = command("report", "--run", "run", "--renderer", "software")
    assert status == 0, errors
    page = (tmp_path / "run" / "report.html").read_text()
    assert "<h2>New rooms</h2>" in page and "No test room of these shards is known in 3D" in page
    assert "<h2>What training saw</h2>" in page and "Real, test split" not in page
    assert "<h2>Scores</h2>" not in page and "read back in 3D" not in page
    status, printed, errors = command("eval-fid", "--run", "run", "-n", 3, "--seed", 1)
    assert status == 0, errors
    assert "Not measured without rooms in 3D" in printed and "Category KL" in printed
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())
    tracked = [s.read_room(r).object_class for s, r in iterate_rooms(toy_shards, "test")]
    assert scores["mean_objects_test"] == np.mean([len(labels) for labels in tracked])
    seen = np.bincount(np.concatenate(tracked), minlength=22) / sum(map(len, tracked))
    made = synthesize(load_run(tmp_path / "run"), 3, 1)
    assert scores["category_kl"] == pytest.approx(frequency_kl(seen, class_frequencies(made)))
    assert scores["mean_objects"] == np.mean([len(scene.objects) for scene in made])
    assert scores["type_share_test"] == 1 and scores["train_rooms"]["category_kl"] >= 0
    low, high = scores["intervals"]["generated"]["mean_objects"]
    assert low <= scores["mean_objects"] <= high
    assert 0 < scores["mask_iou_training_views"] < 1
    assert scores["protocol"]["n_test"] == 4 and "known from views alone" in scores["note"]
    status, _, errors = command("report", "--run", "run", "--renderer", "software")
    page = (tmp_path / "run" / "report.html").read_text()
    assert "<h2>Scores</h2>" in page and "mean mask IoU in training views" in page
    (tmp_path / "run" / "scores.json").unlink()
    # Scenes of any method have scores from views, too.
    write_scenes(made, tmp_path / "made", SoftwareRenderer())
    call = ["eval-fid", "--scenes", "made", "--shards", "bare", "--resamples", 0]
    assert command(*call)[0] == 0
    again = json.loads((tmp_path / "made" / "scores.json").read_text())
    assert again["category_kl"] == pytest.approx(scores["category_kl"])
    assert again["intervals"]["generated"]["mean_objects"] is None
    # Without a test split, too; the training rooms are compared with what they were.
    shutil.rmtree(tmp_path / "bare")
    shutil.copytree(toy_shards, tmp_path / "bare", ignore=shutil.ignore_patterns("test"))
    status, _, errors = command("report", "--run", "run", "--renderer", "software")
    assert status == 0, errors
    page = (tmp_path / "run" / "report.html").read_text()
    assert "<h2>New rooms</h2>" in page and "read back in 3D" in page
    # Runs whose rooms are known still have to be evaluated first.
    config.write_text(config.read_text().replace(str(tmp_path / "bare"), str(toy_shards)))
    status, _, errors = command("report", "--run", "run", "--renderer", "software")
    assert status == 2 and "scores.json holds no scores" in errors


def test_views_that_training_never_saw_are_held_out(toy_shards, toy_run):
    trained = load_run(toy_run)
    assert set(mask_scores(trained, toy_shards)) == {"mask_iou_training_views"}
    data = trained.config.data.model_copy(update={"view_fraction": 0.5})
    half = replace(trained, config=trained.config.model_copy(update={"data": data}))
    (found,) = mask_scores(half, toy_shards).items()
    assert found[0] == "mask_iou_held_out" and 0 < found[1] < 1
    seen, others = (allowed_views(0, 3, 8, 0.5, held_out=held) for held in (False, True))
    assert sorted([*seen, *others]) == list(range(8)) and len(others) == 4
    with pytest.raises(InputError, match="does not hold the training rooms of this run"):
        mask_scores(replace(trained, room_ids=("elsewhere",)), toy_shards)
