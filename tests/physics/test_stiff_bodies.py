"""Bodies that are far stiffer than what a few iterations reach fall freely, whatever the solver and the precision."""

import pytest

import pdipc
from pdipc.linear import SOLVERS

from .scenes import scene, solid

FALLING = [name for name in SOLVERS if name != "a-jacobi"]  # which cannot take the contacts of the default mode


def lost(young_modulus, steps=10, h=0.01, **simulation):
    """The part of its free fall that a block loses, and the height that its ends differ by, m."""
    block = solid("block", (0.2, 0.2, 0.2), (8, 8, 8), young=young_modulus, poisson=0.3)
    made = pdipc.Simulation(scene([block], time_step=h, **simulation), "cpu")
    start = made.positions[:, 1]
    for _ in range(steps):
        made.step()
    fallen = start - made.positions[:, 1]
    expected = 9.81 * h * h * steps * (steps + 1) / 2
    return abs(1.0 - fallen.mean() / expected), fallen.max() - fallen.min()


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("solver", FALLING)
@pytest.mark.parametrize("young_modulus", [1e6, 1e9, 1e11])
def test_a_stiff_block_falls(young_modulus, solver, precision):
    part, bent = lost(young_modulus, linear_solver=solver, precision=precision)
    assert part < 1e-5
    assert bent < 1e-5
