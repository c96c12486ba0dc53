"""The CUDA code of everything a step launches compiles, whether or not the machine has a GPU (linear solvers: tests/linear).

Each module is compiled for one of four architectures, in turn, in float32; in float64, which has the same source, what has code of
CUDA's own for each precision; without optimization. With PDIPC_ALL_ARCHITECTURES set everything is compiled for
all of them in both, optimized as it runs, which takes many times as long.
"""

import zlib

import numpy as np
import pytest
import warp as wp
from device.emulated import Emulated
from device.machine_code import EVERYTHING, compile_all
from factories import STEP

from pdipc.device import launch as parallel
from pdipc.device.precision import real

ARCHITECTURES = (75, 86, 90, 100)


OWN_CODE = {"newton", "descent", "rigid modes", "wide modes", "wide couplings", "wide pcg", "reductions", "time of impact"}


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", STEP)
def test_compiles(name, precision, tmp_path):
    """To machine code."""
    if precision == "float64" and name not in OWN_CODE and not EVERYTHING:
        pytest.skip("the same source is compiled in float32; set PDIPC_ALL_ARCHITECTURES for both")
    turn = zlib.crc32(f"{name} {precision}".encode()) % len(ARCHITECTURES)
    compile_all(STEP[name](real(precision)), ARCHITECTURES if EVERYTHING else ARCHITECTURES[turn : turn + 1], tmp_path)


@pytest.mark.parametrize("count", [1, 3, 255, 256, 257, 70_000])
def test_scan_in_blocks(count):
    """The sums that CUDA takes by its own kernels, with blocks of threads emulated."""
    counts = np.random.default_rng(count).integers(0, 100, count).astype(np.int32)
    ends = wp.zeros(count, dtype=wp.int32, device="cpu")
    Emulated().scan(wp.array(counts, device="cpu"), ends)
    assert np.array_equal(ends.numpy(), np.cumsum(counts))


@pytest.mark.parametrize("count", [1, 255, 256, 257, 300_000])
def test_reductions_in_blocks(count):
    """Sums to rounding, the largest to the bit."""
    values = np.random.default_rng(count).uniform(-1.0, 1.0, count)
    place = Emulated()
    reducer, out = parallel.Reducer(place, real("float64"), count), wp.zeros(2, dtype=wp.float64, device="cpu")
    given = wp.array(values, device="cpu")
    reducer.sum(given, out, 0)
    reducer.max(given, out, 1)
    assert abs(out.numpy()[0] - np.sum(values)) < 1e-15 * np.abs(values).sum()
    assert out.numpy()[1] == values.max()
