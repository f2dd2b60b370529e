"""Functions that read one file of a user: what is no ordinary file is one sentence, at once."""

import errno
import os
import resource
import signal
from pathlib import Path

import pytest

from data_prep.engine.plan import read_splits
from data_prep.readers.annotations import read_hdf5, read_labels
from data_prep.readers.posed.formats import read_label_set
from data_prep.readers.scan_files import open_masks, read_mesh, read_sens
from sceneprior.apps.priors.packed import read_packed
from sceneprior.apps.reconstruction.own_image import read_pose
from sceneprior.apps.retrieval.cad_models import read_glb
from sceneprior.apps.sample import load_request
from sceneprior.core.coco import read_coco_json
from sceneprior.core.errors import InputError
from sceneprior.core.files import list_files, list_folders, reading
from sceneprior.core.furniture import read_obj
from sceneprior.core.ground_truth import load_model
from sceneprior.core.id_tables import read_class_table, read_mask
from sceneprior.core.settings import read_yaml
from sceneprior.core.shards import Shard
from sceneprior.interchange.box_lists import read_box_lists
from sceneprior.interchange.floors import read_floor_file
from sceneprior.render.scene_files import load_scene
from sceneprior.training.method import read_checkpoint


def masks_of(path):
    with open_masks(path):
        pass


READ = {
    ".json": [
        load_request,
        read_floor_file,
        load_scene,
        read_class_table,
        read_coco_json,
        read_pose,
    ],
    ".csv": [read_class_table, read_splits, read_labels],
    ".txt": [read_label_set],
    ".yaml": [read_yaml],
    ".png": [read_mask],
    ".ply": [read_mesh, load_model],
    ".obj": [read_obj],
    ".glb": [read_glb],
    ".npz": [read_floor_file, lambda path: read_box_lists(path, "front3d_bedroom")],
    ".zip": [masks_of],
    ".sens": [read_sens],
    ".h5": [Shard, lambda path: read_hdf5(path, ["a"], "render it again")],
    ".prior": [read_packed],
    ".ckpt": [read_checkpoint],
}
READERS = [(ending, read) for ending, reads in READ.items() for read in reads]


def as_huge(path):
    with path.open("wb") as file:
        file.truncate(3 << 30)


NO_FILES = {
    "pipe": os.mkfifo,
    "device": lambda path: path.symlink_to("/dev/zero"),
    "loop": lambda path: path.symlink_to(path),
    "folder": Path.mkdir,
    "huge": as_huge,
}


@pytest.fixture
def at_once():
    def late(*_):
        raise AssertionError("nothing after 20 s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("kind", NO_FILES)
@pytest.mark.parametrize(("ending", "read"), READERS)
@pytest.mark.usefixtures("at_once")
def test_what_is_no_ordinary_file_is_a_sentence(tmp_path, ending, read, kind):
    path = tmp_path / f"a{ending}"
    NO_FILES[kind](path)
    held = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"\ba\b"):
        read(str(path) if read in (read_floor_file, read_label_set) else path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - held < 1 << 20  # KB


@pytest.mark.parametrize("ending", [".h5", ".ckpt", ".prior", ".ply", ".glb"])
def test_a_file_is_not_called_damaged_for_want_of_descriptors(tmp_path, ending):
    path = tmp_path / f"a{ending}"
    path.write_bytes(b"any")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    for read in READ[ending]:
        with pytest.raises(InputError):
            read(path)  # imports what it needs
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
        try:
            with pytest.raises(InputError) as error:
                read(path)
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        said = str(error.value)
        assert "Too many open files" in said and "damaged" not in said and "elete" not in said


def test_errors_of_the_system_are_not_damage(tmp_path):
    for error in (PermissionError(errno.EACCES, "no"), MemoryError(), KeyError("a")):
        with pytest.raises(InputError) as told, reading(tmp_path, then="torn"):
            raise error
        assert str(told.value).endswith("torn") == isinstance(error, KeyError)


def test_inputs_are_listed_without_what_systems_add(tmp_path):
    for name in ("b/2.png", "a.png", "b/._2.png", ".DS_Store", "__MACOSX/x.png", ".x/y.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "c.png").symlink_to("gone")  # reading it will say so
    (tmp_path / "b" / "up").symlink_to(tmp_path)
    there = [tmp_path / name for name in ("a.png", "b/2.png", "c.png")]
    assert list_files(tmp_path, "*.png", deep=True) == there
    assert list_files(tmp_path) == [there[0], there[2]]
    assert list_folders(tmp_path) == [tmp_path / "b"] and list_files(tmp_path / "gone") == []
