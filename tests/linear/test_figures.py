"""Figures 7 and 8 in their small size: files are written, and the curves show what the documents say."""

import csv

import pytest

from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.reproduce import fig7, fig8

pytest.importorskip("matplotlib")


def rows(path):
    with path.open() as file:
        return list(csv.DictReader(file))


def test_fig7(tmp_path):
    """Each method arrives in fewer iterations than the one it improves; A-Jacobi of order 2 in half of Chebyshev's."""
    picture = fig7.run(tmp_path, small=True, device="cpu")
    assert picture.stat().st_size > 20_000
    best = {}
    for row in rows(tmp_path / "fig7.csv"):
        assert float(row["seconds"]) > 0.0
        if float(row["relative_error"]) < 1e-3:
            key = row["load"], row["solver"]
            best[key] = min(best.get(key, 10**9), int(row["iterations"]))
    for load in ("gravity", "sharp force"):
        count = {label: best.get((load, label), 10**9) for label in fig7.PAPER | fig7.ADDED}
        assert count["A-Jacobi, order 2"] <= 0.7 * count["Chebyshev"]
        assert count["A-Jacobi, order 3, lossless"] < count["A-Jacobi, order 2"]
        assert count["matrix powers, order 2"] == count["A-Jacobi, order 2"]
        assert count["Chebyshev"] < count["Gauss-Seidel"] and count["SOR"] < count["Gauss-Seidel"]
        assert count["two-level PCG"] < count["A-Jacobi, order 3"]


def test_fig8(tmp_path):
    """Every variant is measured, and leaving out bending with bending saves memory."""
    picture = fig8.run(tmp_path, small=True, device="cpu")
    assert picture.stat().st_size > 10_000
    found = rows(tmp_path / "fig8.csv")
    assert len(found) == len(fig8.SMALL) * len(fig8.VARIANTS)
    memory = {(row["dof"], row["variant"]): int(row["bytes"]) for row in found}
    for side in fig8.SMALL:
        dof = str(3 * side * side)
        assert memory[dof, "order 2, no bend-bend (Eq. 16)"] < memory[dof, "order 2"] < memory[dof, "order 3"]


def test_table_cloth():
    """The parts add up to the system's matrix, which is positive definite and carries the mass."""
    system, mass, (stretch, bend) = fig7.table_cloth(8, Device("cpu", threads=1), real("float64"))
    assert abs(system.matrix - stretch - bend).max() < 1e-9
    assert mass.sum() == pytest.approx(fig7.AREAL_DENSITY)
    assert system.interval[0] > 0.0
    assert (~system.free).sum() == 4
