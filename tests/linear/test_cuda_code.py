"""The CUDA code of all linear kernels compiles, whether or not the machine has a GPU."""

import pytest
from device.machine_code import EVERYTHING, compile_all
from factories import LINEAR

from pdipc.device.precision import real

SAME_SOURCE = {"jacobi", "gauss-seidel"}  # in both precisions: no code of CUDA's own


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", LINEAR)
def test_compiles(name, precision, tmp_path):
    """To machine code for one architecture, which also checks the limit on shared memory."""
    if precision == "float64" and name in SAME_SOURCE and not EVERYTHING:
        pytest.skip("the same source is compiled in float32; set PDIPC_ALL_ARCHITECTURES for both")
    compile_all(LINEAR[name](real(precision)), [86], tmp_path)
