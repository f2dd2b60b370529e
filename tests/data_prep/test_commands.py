"""The commands as a user meets them: what they print, and their exit status."""

import pytest
from front_files import bedroom
from front_jobs import SMALL, three_houses


@pytest.fixture
def prep(front, tmp_path, cli):
    def run(*words):
        rules = [word for rule in SMALL for word in ("--rule", rule)]
        return cli(
            "prep-front", "--front", front.front, "--future", front.future,
            "--out", tmp_path / "shards", "--workers", 1, "--renderer", "software", *rules, *words,
        )  # fmt: skip

    return run


def test_failed_rooms_give_status_3_and_filtered_ones_do_not(front, tmp_path, prep):
    front.house("house", bedroom("Bedroom-1"), bedroom("Bedroom-2"), bedroom("Bedroom-3"))
    (front.front / "broken.json").write_text('{"scene": {"room": [')
    made = prep()
    assert made.exit_code == 3, made.output
    assert "failed" in made.stdout and "broken" in made.stdout and "not JSON" in made.stdout
    assert "1 failed (report.csv says why)" in made.stdout
    assert (tmp_path / "shards" / "index.json").is_file()
    assert prep().exit_code == 3  # in a finished folder, too
    (tmp_path / "shards" / "test" / "bedroom_0000.h5").unlink()
    part = prep("--only", "house/Bedroom-2")  # the failure is no business of this room's
    assert part.exit_code == 0 and "1 failed" not in part.stdout, part.output
    assert '"broken"' in (tmp_path / "shards" / "report.json").read_text()


def test_one_room_is_enough_to_train_on(front, prep):
    front.house("house", bedroom("Bedroom-1"))
    made = prep()
    assert made.exit_code == 0 and "train 1 rooms" in made.stdout, made.output
    assert "Note: the 'test' split is empty. `fit` and `synthesize` do not" in made.stderr


def test_a_wrong_list_of_models_is_told_once(front, tmp_path, prep):
    three_houses(front)
    (front.future / "model_info.json").write_text('{"a": 1}')
    said = str(prep().exception)
    assert said.count("is not 3D-FUTURE's list of models") == 1
    assert said.startswith(str(front.future)) and "left out" not in said
    assert not (tmp_path / "shards").exists()


def test_only_in_a_whole_folder_says_what_is_still_to_make(front, tmp_path, prep):
    front.house("house", *(bedroom(f"Bedroom-{k}") for k in range(12)))
    assert prep().exit_code == 0
    for path in (tmp_path / "shards").glob("*/*.h5"):
        path.unlink()
    made = prep("--only", "house/Bedroom-2")
    assert made.exit_code == 0, made.output
    said = " ".join(made.stdout.split())
    assert "1 shards made, 0 already there, 3 still to make: run without --only" in said


def test_wrong_words(front, tmp_path, prep, cli):
    three_houses(front)
    odd = bedroom("Bedroom-9")
    odd["instanceid"] = "[/] [bold]"  # rich must not take it for markup
    odd["children"] = {"a": 1}
    front.house("odd", odd)
    made = prep()
    assert made.exit_code == 3 and "its instanceid, '[/] [bold]'" in made.stdout, made.output
    result = cli(
        "prep-front", "--front", front.front, "--future", front.future,
        "--out", tmp_path / "other", "--workers", 1, "--recipe", "library",
    )  # fmt: skip
    assert result.exit_code
    assert "selects (library); the folder has Bedroom (7)" in str(result.exception)
    assert not (tmp_path / "other").exists()
