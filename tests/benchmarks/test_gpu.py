"""`benchmarks/gpu.py` on a CPU with tiny sizes: no minute of a GPU is lost to a typo."""

import json
from pathlib import Path

import gpu
import pytest

ON_CPU = ["--device", "cpu", "--tiny"]


def test_a_part_that_fails_or_hangs_is_a_line_and_the_next_one_runs(tmp_path: Path):
    # Half an hour: a test machine may be busy.
    parts = {
        "precision": gpu.PARTS["precision"]._replace(minutes=1 / 600),
        "peers": gpu.PARTS["peers"]._replace(minutes=30),
    }
    found = gpu.run(parts, tmp_path, ON_CPU)["parts"]
    assert found["precision"]["failed"].startswith("stopped after 0.0 minutes")
    assert found["peers"]["failed"] is None and len(found["peers"]["rows"]) == 2
    assert json.loads((tmp_path / "gpu.json").read_text())["parts"] == found
    table = (tmp_path / "gpu.md").read_text()
    assert "| **not measured to the end**: stopped after" in table
    assert "| pytorch3d: not installed |" in table or "| pytorch3d |" in table
    said = gpu.run_part("peers", tmp_path, ["--device", "nothing"], 1800)
    assert said is not None and "invalid choice: 'nothing'" in said


def test_without_a_gpu_it_says_so(monkeypatch, capsys):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(SystemExit):
        gpu.main([])
    assert "torch finds no GPU here" in capsys.readouterr().err


@pytest.mark.slow
def test_all_of_it_on_a_cpu(tmp_path: Path, capsys, monkeypatch):
    # A test machine may be busy.
    patient = {name: part._replace(minutes=30) for name, part in gpu.PARTS.items()}
    monkeypatch.setattr(gpu, "PARTS", patient)
    gpu.main([*ON_CPU, "--out", str(tmp_path / "out")])
    found = json.loads((tmp_path / "out" / "gpu.json").read_text())
    assert [part["failed"] for part in found["parts"].values()] == [None] * len(gpu.PARTS)
    assert found["parts"].keys() == gpu.PARTS.keys()
    assert all(part["rows"] for part in found["parts"].values())
    for row in found["parts"]["processes"]["rows"]:
        # Adam follows gradients that are round-off alone, too: not to the last digit.
        assert row["figures"]["weights_off"] < 1e-4 and row["figures"]["two_over_one"] > 0
    table = (tmp_path / "out" / "gpu.md").read_text()
    assert table in capsys.readouterr().out
    # No file of views comes with the package.
    sphere = "| not measured: name a file of views with --flat |"
    assert table.count("not measured") == table.count(sphere) == 1
