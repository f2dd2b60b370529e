"""Every file of a made scene, cut in half, replaced by noise or emptied: one sentence, no crash."""

import pytest
from public_files import (
    cam_from_uv,
    furnished,
    write_blenderproc,
    write_hypersim,
    write_scannetpp,
    write_structured3d,
)

from data_prep.engine.source import Line, PreparedRoom
from data_prep.engine.workers import pool
from data_prep.readers.source import PublicSource, open_reader
from sceneprior.core.errors import InputError


def hypersim(folder, room):
    write_hypersim(folder, "ai_001_001", room, cam_from_uv(room))


WRITERS = {
    "blenderproc": lambda folder, room: write_blenderproc(folder, "house", room),
    "hypersim": hypersim,
    "structured3d": lambda folder, room: write_structured3d(folder, "scene_00001", "480", room),
    "scannetpp": lambda folder, room: write_scannetpp(folder, "0a5c", room),
    "scannetpp of COLMAP": lambda folder, room: write_scannetpp(folder, "0a5c", room, "colmap"),
    "scannetpp of an iPhone": lambda folder, room: write_scannetpp(folder, "0a5c", room, "iphone"),
}
DAMAGES = {
    "cut": lambda data, numbers: data[: len(data) // 2],
    "noise": lambda data, numbers: numbers.bytes(len(data)),
    "empty": lambda data, numbers: b"",
    "another format": lambda data, numbers: b'{"format": 1, "rows": [[1, 2], null]}',
}


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", WRITERS)
def test_damaged_files_end_in_one_sentence(tmp_path, name, damage, numbers):
    folder = tmp_path / "data"
    room = furnished(tmp_path)
    del room.poses[2:]
    WRITERS[name](folder, room)
    named = 0
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        whole = path.read_bytes()
        path.write_bytes(DAMAGES[damage](whole, numbers))
        try:
            source = PublicSource(open_reader(name.partition(" ")[0], folder))
            source.settings(None)
            with pool(1) as run:
                tasks = source.survey(run).rooms
            for task in tasks:
                assert isinstance(source.prepare(task, None), Line | PreparedRoom)
        except InputError as error:
            message = str(error)
            assert "unforeseen" not in message and "\n" not in message, (path, message)
            named += path.name in message or path.parent.name in message
        path.write_bytes(whole)
    assert named
