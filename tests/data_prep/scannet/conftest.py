"""A made scan in ScanNet's format, and its label table."""

from pathlib import Path

import pytest
from scan_files import ScanFolder, make_scan, write_table

from data_prep.readers.scannet.labels import Labels, read_labels


@pytest.fixture
def scan(tmp_path: Path) -> ScanFolder:
    """Not written yet."""
    return make_scan(tmp_path / "scans" / "scene0000_00")


@pytest.fixture
def labels(tmp_path: Path) -> Labels:
    return read_labels(write_table(tmp_path / "scannetv2-labels.combined.tsv"))
