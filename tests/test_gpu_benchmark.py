"""benchmarks/gpu.py: the whole command, on the CPU, and what it says where there is no GPU."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import warp as wp

from pdipc.device.launch import Device

COMMAND = [sys.executable, str(Path(__file__).parents[1] / "benchmarks" / "gpu.py")]


def test_all_checks_on_the_cpu(tmp_path, monkeypatch):
    """References prepared beforehand, then all checks and a few of the times on small cases."""
    monkeypatch.syspath_prepend(str(Path(COMMAND[1]).parent))
    import gpu

    assert gpu.main(["--prepare", str(tmp_path), "--case", "box_stack float64", "--small"]) == 0
    lines, place = tmp_path / "gpu.jsonl", Device("cpu")
    for name in ("scenes", "kernels", "ccd", "worlds", "peer scenes"):
        part = gpu.PARTS[name]
        for case in part.cases(True):
            part.run(gpu.Report(lines, name, case, 60.0), place, case, tmp_path)
    results = gpu.read(lines)
    checks = [line for line in results if "check" in line]
    assert len(checks) > 60
    assert all(check["passed"] and check["found"] <= check["limit"] for check in checks)
    assert next(line for line in results if line["case"] == "s2_2" and "steps" in line)["steps"] > 0


def test_the_command_on_the_cpu(tmp_path):
    """In processes of its own: one part, whose references it makes."""
    options = ["--device", "cpu", "--small", "--jobs", "1", "-o", tmp_path, "--only", "ccd"]
    done = subprocess.run([*COMMAND, *options], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads((tmp_path / "gpu.json").read_text())
    assert found["ok"]
    results = found["results"]
    assert results == [line for line in map(json.loads, (tmp_path / "gpu.jsonl").open()) if "begun" not in line]
    assert [line["case"] for line in results if "ended" in line] == ["float32", "float64"]
    assert sum("check" in line for line in results) == 12


def test_kernels_are_compiled_beforehand(tmp_path, monkeypatch):
    """Into a cache as Warp names it, for the architecture that was asked for; once."""
    monkeypatch.syspath_prepend(str(Path(COMMAND[1]).parent))
    import gpu

    from tests import factories

    monkeypatch.setattr(factories, "STEP", {"forces": factories.STEP["forces"]})
    monkeypatch.setattr(factories, "LINEAR", {})
    for _ in range(2):
        gpu.checks.compile_kernels(tmp_path, 90, ("float32",))
        (folder,) = (tmp_path / wp.config.version).iterdir()
        assert "loads.float32" in folder.name
        (binary,) = folder.glob("*.sm90.cubin")
        assert binary.stat().st_size > 1000


def test_what_breaks_costs_nothing_else(tmp_path, monkeypatch):
    """A case that raises, one that ends its process and one that hangs leave the others their turn; the run fails and says why."""
    monkeypatch.syspath_prepend(str(Path(COMMAND[1]).parent))
    import gpu

    report = gpu.Report(tmp_path / "gpu.jsonl", "part", "case", 10.0)
    report.check("small", float("nan"), 1.0)
    assert not gpu.sound(gpu.read(report.path))
    broken = tmp_path / "broken.py"
    broken.write_text(
        f"""
import os, sys, time
from pathlib import Path
sys.path.insert(0, {str(Path(COMMAND[1]).parent)!r})
import gpu
def run(report, place, case, carried):
    if case == "raises": raise ValueError("told")
    if case == "ends": os._exit(3)
    if case == "hangs": time.sleep(60)
    report.add(speed=2.0)
gpu.PARTS = {{"part": gpu.Part(run, lambda small: ["raises", "first", "ends", "hangs", "last"], 4.0)}}
gpu.GRACE = 0.5
gpu.__file__ = __file__
sys.exit(gpu.main())
"""
    )
    command = [sys.executable, broken, "--device", "cpu", "-o", tmp_path]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 1, done.stdout + done.stderr
    assert "ValueError: told" in done.stdout
    assert "time.sleep(60)" in done.stdout or "in run" in done.stdout  # where it hung
    results = json.loads((tmp_path / "gpu.json").read_text())["results"]
    assert [line["case"] for line in results if "speed" in line] == ["first", "last"]
    assert [line["case"] for line in results if "broken" in line] == ["raises", "ends", "hangs"]


@pytest.mark.skipif(wp.is_cuda_available(), reason="there is a GPU, on which this would run for minutes")
def test_without_a_gpu_it_says_so():
    done = subprocess.run(COMMAND, capture_output=True, text=True)
    assert done.returncode == 2
    assert "no CUDA device was found" in done.stderr


def test_prediction(monkeypatch):
    """Three launches an iteration; no step is faster than its launches or its bytes; a slower memory takes no less, more iterations take longer."""
    monkeypatch.syspath_prepend(str(Path(COMMAND[1]).parent))
    import gpu_predict

    row = {"outer": 3.0, "linear_iterations": 40.0, "truncations": 0.0, "barriers": 100.0, "mean ms": 1.0}
    scene = gpu_predict.peer_scenes.scene("s2_2", precision="float32")
    found = gpu_predict.predict("s2_2", scene, row)
    assert found["an iteration"] == 3
    assert found["RTX 3090"] >= found["H100"] > 1e3 * gpu_predict.LAUNCH * found["launches"] + found["memory ms"]
    more = gpu_predict.predict("s2_2", scene, row | {"linear_iterations": 140.0})
    assert more["launches"] - found["launches"] == pytest.approx(300)
    assert more["H100"] > found["H100"]
