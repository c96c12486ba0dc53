"""benchmarks/gpu.py: the whole command, on the CPU, and what it says where there is no GPU."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

COMMAND = [sys.executable, str(Path(__file__).parents[1] / "benchmarks" / "gpu.py")]


def test_the_command_on_the_cpu(tmp_path):
    out = tmp_path / "gpu.json"
    done = subprocess.run([*COMMAND, "--device", "cpu", "--small", "-o", out], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(out.read_text())
    assert found["ok"]
    parts = found["parts"]
    checks = [check for part in parts.values() for check in part["checks"]]
    assert len(checks) > 35
    assert all(check["passed"] and check["found"] <= check["limit"] for check in checks)
    assert len(parts) == 7
    rows = parts["solvers over sizes (Fig. 8)"]["rows"]
    assert {row["variant"] for row in rows if "variant" in row} >= {"order 1 (Jacobi)", "order 2", "order 3"}
    assert all(row["of copy"] > 0.0 for row in rows if "of copy" in row)
    assert parts["benchmark scenes"]["rows"][0]["steps"] == 3


def test_what_breaks_costs_nothing_else(tmp_path, monkeypatch):
    """A case that raises leaves the others their turn; a part that hangs is ended, keeps what it had, and fails the run."""
    monkeypatch.syspath_prepend(str(Path(COMMAND[1]).parent))
    import gpu

    report = gpu.Report(10.0, tmp_path / "part.json")
    report.attempt("first", lambda: 1 / 0)
    report.attempt("second", lambda: report.add(speed=2.0))
    report.check("small", float("nan"), 1.0)
    kept = json.loads((tmp_path / "part.json").read_text())
    assert kept["rows"] == [{"case": "first", "broken": "ZeroDivisionError: division by zero"}, {"speed": 2.0}]
    assert not kept["checks"][0]["passed"]
    fine = {"checks": [], "rows": [{"speed": 2.0}]}
    assert gpu.sound({"fine": fine})
    assert not gpu.sound({"fine": fine, "kept": kept | {"checks": []}})
    assert not gpu.sound({"fine": fine, "kept": kept | {"rows": []}})
    ended = gpu.start_part("CCD", "cpu", True, -9.9, tmp_path / "part.json")
    assert "did not end within" in ended["broken"]
    assert ended["rows"] == kept["rows"]
    assert not gpu.sound({"ended": ended})


@pytest.mark.skipif(wp.is_cuda_available(), reason="there is a GPU, on which this would run for minutes")
def test_without_a_gpu_it_says_so():
    done = subprocess.run(COMMAND, capture_output=True, text=True)
    assert done.returncode == 2
    assert "no CUDA device was found" in done.stderr
