"""benchmarks/solvers.py: what it writes, also where its time is over."""

import json
import subprocess
import sys
from pathlib import Path

COMMAND = [sys.executable, str(Path(__file__).parents[2] / "benchmarks" / "solvers.py")]


def measure(out, *options):
    command = [*COMMAND, "--cases", "stiff cloth", "--only", "pcg", "two-level", "scipy cg", "--threads", "1", "-o", str(out)]
    done = subprocess.run([*command, *options], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(out.read_text())


def test_the_table(tmp_path):
    found = measure(tmp_path / "solvers.json", "--sizes", "400", "900")
    rows = {(row["solver"], row["load"], row["vertices"]): row for row in found["rows"]}
    assert len(rows) == 3 * 2 * 2
    for row in rows.values():
        low, high = row["quartiles"]
        assert 0.0 < low <= row["seconds"] <= high
        assert row["repeats"] >= 3
    for load in ("rough", "smooth"):
        # the same method with the same preconditioner: the same iterations
        assert rows["pcg", load, 400]["iterations"] == rows["scipy cg", load, 400]["iterations"]
        assert rows["two-level", load, 900]["iterations"] < rows["pcg", load, 900]["iterations"]
    assert len(found["growth"]) == 6
    assert len(found["aims"]) == 4
    assert all(entry["default / fastest"] >= 1.0 for entry in found["aims"])


def test_no_time(tmp_path):
    found = measure(tmp_path / "solvers.json", "--sizes", "400", "--minutes", "0")
    assert [row["skipped"] for row in found["rows"]] == 3 * ["no time left"]
