"""The text, JSON and mesh files of a scan, whole and damaged."""

import json

import numpy as np
import pytest
from scan_files import BOX_FACES, write_ply

from data_prep.readers.scannet.annotations import (
    Group,
    axis_alignment,
    read_groups,
    read_mesh,
    read_properties,
    read_segments,
)
from sceneprior.core.errors import InputError


@pytest.fixture
def write(tmp_path):
    def at(name, content):
        path = tmp_path / name
        path.write_text(content if isinstance(content, str) else json.dumps(content))
        return path

    return at


def group(number, label="chair", segments=(1, 2)):
    return {"id": 9, "objectId": number, "segments": list(segments), "label": label}


def test_properties_are_lines_of_key_and_value(write):
    path = write("a.txt", "axisAlignment = 1 0 \nsceneType = Bedroom / Hotel\n\nno pair\n")
    assert read_properties(path) == {"axisAlignment": "1 0", "sceneType": "Bedroom / Hotel"}


def test_alignment_is_row_major_and_may_be_absent(tmp_path):
    numbers = "0 -1 0 2 1 0 0 3 0 0 1 4 0 0 0 1"
    matrix = axis_alignment(tmp_path, {"axisAlignment": numbers})
    assert matrix.tolist() == [[0, -1, 0, 2], [1, 0, 0, 3], [0, 0, 1, 4], [0, 0, 0, 1]]
    np.testing.assert_array_equal(axis_alignment(tmp_path, {}), np.eye(4))


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ("1 0 0", "axisAlignment is 3 words, expected 16 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 nan", "it holds NaN or infinity; the file is damaged"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 1 0 0 1", "it is transposed: its translation is in the last row"),
    ],
)
def test_alignments_that_are_none(tmp_path, numbers, words):
    with pytest.raises(InputError, match=r"a\.txt: .*" + words):
        axis_alignment(tmp_path / "a.txt", {"axisAlignment": numbers})


def test_groups_come_by_object_id(write):
    path = write("a.json", {"segGroups": [group(5, "bed"), group(2)]})
    found, notes = read_groups(path)
    assert found == [Group(2, "chair", frozenset({1, 2})), Group(5, "bed", frozenset({1, 2}))]
    assert notes == []


def test_an_object_listed_twice_is_joined_and_told(write):
    path = write("a.json", {"segGroups": [group(2, "bed", [1]), group(2, "sofa", [7])]})
    found, notes = read_groups(path)
    assert found == [Group(2, "bed", frozenset({1, 7}))]
    assert notes == ["object 2 is listed twice; its parts were joined"]


@pytest.mark.parametrize(
    ("read", "data", "said"),
    [
        (read_groups, [], r"it is \[\]; expected a JSON object"),
        (read_groups, {"segGroups": [{"objectId": 1}]}, r"segGroups\.0\.label is .*field required"),
        (read_groups, {"segGroups": [group(-1)]}, r"objectId is -1; .*greater than or equal to 0"),
        (read_groups, {"segGroups": [group(True)]}, r"objectId is True; .* valid integer"),
        (read_groups, {"segGroups": [group(1, None)]}, r"label is None; .* valid string"),
        (read_groups, {"segGroups": [group(1, segments=["x"])]}, r"segments\.0 is 'x'; .* integer"),
        (read_segments, {}, "segIndices is {}; field required"),
        (read_segments, {"segIndices": [1.5, 2]}, r"segIndices\.0 is 1\.5; .* valid integer"),
    ],
)
def test_json_of_another_kind(write, read, data, said):
    with pytest.raises(InputError, match=rf"a\.json: .*{said}.*\. Download the scan again"):
        read(write("a.json", data))


@pytest.mark.parametrize("read", [read_groups, read_segments])
def test_json_that_is_missing_or_cut(write, read, tmp_path):
    text = json.dumps({"segGroups": [group(1)], "segIndices": [1, 2, 3]})
    for cut in range(len(text)):
        with pytest.raises(InputError, match=r"a\.json is not JSON .*truncated"):
            read(write("a.json", text[:cut]))
    with pytest.raises(InputError, match="is not JSON"):
        read(write("a.json", "[" * 100_000))
    (tmp_path / "a.json").write_bytes(b"\xff\xfe{}")
    with pytest.raises(InputError, match="is not JSON"):
        read(tmp_path / "a.json")
    with pytest.raises(InputError, match=r"none\.json cannot be read .no such file.*; .* leave"):
        read(tmp_path / "none.json")


def test_properties_that_cannot_be_read(tmp_path):
    with pytest.raises(InputError, match=r"a\.txt cannot be read .No such file"):
        read_properties(tmp_path / "a.txt")
    (tmp_path / "a.txt").write_bytes(b"\xff\xfe")
    with pytest.raises(InputError, match=r"a\.txt cannot be read .*utf-8"):
        read_properties(tmp_path / "a.txt")


def test_a_mesh_that_is_missing_damaged_or_cut(tmp_path, rng):
    path = write_ply(tmp_path / "a.ply", rng.normal(size=(8, 3)), BOX_FACES)
    data = path.read_bytes()
    begin = data.index(b"end_header\n") + 11
    for cut in range(0, len(data), 3):
        path.write_bytes(data[:cut])
        try:
            mesh = read_mesh(path)
        except InputError as error:
            assert "a.ply is not a mesh" in str(error) or "a.ply holds no vertices" in str(error)
        else:
            # Half the vertices would be noticed beside segs.json; lost triangles are not.
            assert len(mesh.vertices_m) == 8 and cut >= begin + 8 * 16
    with pytest.raises(InputError, match=r"none\.ply cannot be read .no such file"):
        read_mesh(tmp_path / "none.ply")
    broken = np.full((8, 3), np.nan)
    with pytest.raises(InputError, match="holds no vertices, or broken ones"):
        read_mesh(write_ply(path, broken, BOX_FACES))


def test_triangles_of_vertices_that_are_not_there(tmp_path, rng):
    faces = np.array([(0, 1, 2), (0, 1, 8)])
    with pytest.raises(InputError, match=r"a\.ply has triangles of vertices it lacks"):
        read_mesh(write_ply(tmp_path / "a.ply", rng.normal(size=(8, 3)), faces))
