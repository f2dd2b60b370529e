"""Search for priors: paths first, then names, and repositories of the Hub."""

import shutil
import sys
import zipfile
from pathlib import Path

import pytest

from sceneprior.apps.config import load_any_run
from sceneprior.apps.priors.packed import FILES, find_prior, pack, shipped_priors, write_packed
from sceneprior.apps.sample import sample_rooms
from sceneprior.core.errors import InputError

COMMIT = "0123456789abcdef0123456789abcdef01234567"


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
    with pytest.raises(
        InputError, match=r"needs one more package: pip install 'sceneprior\[hub\]'"
    ):
        find_prior("hf://someone/bedrooms")


def test_paths_come_before_names(tmp_path, monkeypatch):
    name = next(iter(shipped_priors()))
    assert find_prior(name) == shipped_priors()[name]
    monkeypatch.chdir(tmp_path)
    shutil.copy(shipped_priors()[name], tmp_path / name)
    assert find_prior(name) == Path(name)
    with pytest.raises(InputError, match=rf"No prior at nothing; give a run's folder .*{name}"):
        find_prior("nothing")
