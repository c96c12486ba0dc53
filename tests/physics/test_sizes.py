"""A scene a thousand times as large moves alike, from a tenth of a millimetre to a hundred metres, and in float32 as in float64."""

import numpy as np
import pytest

import pdipc

from .scenes import cloth, floor, scene, solid

SIZES = [1e-4, 1e-2, 1.0, 100.0]  # m


def fallen(size: float, precision: str, steps: int = 25) -> np.ndarray:
    """Where the middles of a block and of a cloth that lands on it are, in sizes: stiffnesses, densities and time are such that the motion is the same."""
    block = solid("block", (size,) * 3, (3, 3, 3), at=(0, 0.85 * size, 0), rotation=(10, 20, 5), young=1e6 * size)
    sheet = cloth("sheet", (2 * size, 2 * size), (10, 10), at=(0, 1.9 * size, 0))
    sheet["material"] = {
        "areal_density": 2 * size,
        "membrane_stiffness": 1e4 * size**2,
        "bending_stiffness": min(1e6, 0.1 * size**4),
    }
    made = scene(
        [block, sheet],
        [floor(10 * size)],
        time_step=0.03 * np.sqrt(size),
        precision=precision,
        tolerance=0.03 * np.sqrt(size),
    )
    simulation = pdipc.Simulation(made, "cpu")
    for _ in range(steps):
        assert simulation.step().converged
    x = simulation.positions / size
    return np.array([x[:64].mean(axis=0), x[64 : 64 + 121].mean(axis=0)])


@pytest.mark.parametrize("size", SIZES)
def test_the_motion_is_the_same_at_any_size_and_in_any_precision(size):
    wanted = fallen(0.1, "float64")
    assert (wanted[:, 1] < [0.7, 1.6]).all()  # from 0.85 and 1.9
    for precision in ("float64", "float32"):
        assert fallen(size, precision) == pytest.approx(wanted, abs=0.01)
