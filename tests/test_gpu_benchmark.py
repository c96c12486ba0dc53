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
    assert len(found["checks"]) > 35
    assert all(check["passed"] and check["found"] <= check["limit"] for check in found["checks"])
    assert len(found["parts"]) == 7
    rows = found["parts"]["solvers over sizes (Fig. 8)"]
    assert {row["variant"] for row in rows if "variant" in row} >= {"order 1 (Jacobi)", "order 2", "order 3"}
    assert all(row["of copy"] > 0.0 for row in rows if "of copy" in row)
    assert found["parts"]["benchmark scenes"][0]["steps"] == 3


@pytest.mark.skipif(wp.is_cuda_available(), reason="there is a GPU, on which this would run for minutes")
def test_without_a_gpu_it_says_so():
    done = subprocess.run(COMMAND, capture_output=True, text=True)
    assert done.returncode == 2
    assert "no CUDA device was found" in done.stderr
