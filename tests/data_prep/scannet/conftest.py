"""A made scan in ScanNet's format, and its label table."""

from pathlib import Path

import numpy as np
import pytest
from scan_files import Box, ScanFolder, write_table

from data_prep.scannet.labels import Labels, read_labels


def alignment() -> np.ndarray:
    """A turn by 0.6 rad about z, and a move: what axisAlignment is in the release."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(0.6), -np.sin(0.6)], [np.sin(0.6), np.cos(0.6)]]
    matrix[:3, 3] = -1.5, 2.0, -0.07
    return matrix


def make_scan(folder: Path) -> ScanFolder:
    """A bed, a chair and a backpack on a floor, seen by six cameras; the third has no pose."""
    scan = ScanFolder(
        folder,
        [
            Box("floor", (-0.5, -0.5, 0.0), (4.5, 3.5, 0.04)),
            Box("bed", (0.0, 0.0, 0.05), (2.0, 1.5, 0.65)),
            Box("chair", (3.0, 2.0, 0.05), (3.5, 2.5, 0.95)),
            Box("backpack", (3.0, 0.3, 0.05), (3.4, 0.6, 0.6)),
        ],
        alignment(),
    )
    for k, eye in enumerate(
        [(-2.5, -2, 2.5), (5, -2.5, 1.8), None, (6, 4, 2.2), (0.5, 5.5, 2.0), (-2, 4, 1.6)]
    ):
        if eye is None:
            scan.lose()
        else:
            scan.look(eye, (1.9, 1.2 + 0.05 * k, 0.5))
    return scan


@pytest.fixture
def scan(tmp_path: Path) -> ScanFolder:
    """Not written yet."""
    return make_scan(tmp_path / "scans" / "scene0000_00")


@pytest.fixture
def labels(tmp_path: Path) -> Labels:
    return read_labels(write_table(tmp_path / "scannetv2-labels.combined.tsv"))
