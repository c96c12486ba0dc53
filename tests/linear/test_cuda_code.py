"""The CUDA code of all linear kernels compiles, whether or not the machine has a GPU."""

import pytest
from device.machine_code import EVERYTHING, compile_all

from pdipc.device.precision import real
from pdipc.linear import coarse, kernels, pcg, translations
from pdipc.linear.paper import a_jacobi as aggregated
from pdipc.linear.paper import gauss_seidel, jacobi, powers

FACTORIES = {
    "shared": kernels.kernels,
    "pcg": pcg.kernels,
    "two-level": coarse.kernels,
    "jacobi": jacobi.kernels,
    "a-jacobi": aggregated.kernels,
    "a-jacobi in groups": lambda precision: aggregated.group_kernels(precision, aggregated.capacity_on_cuda(precision)),
    "matrix powers": lambda precision: powers.group_kernels(precision, powers.capacity_on_cuda(precision)),
    "gauss-seidel": gauss_seidel.kernels,
    "translations": translations.kernels,
}


SAME_SOURCE = {"jacobi", "gauss-seidel"}  # in both precisions: no code of CUDA's own


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", FACTORIES)
def test_compiles(name, precision, tmp_path):
    """To machine code for one architecture, which also checks the limit on shared memory."""
    if precision == "float64" and name in SAME_SOURCE and not EVERYTHING:
        pytest.skip("the same source is compiled in float32; set PDIPC_ALL_ARCHITECTURES for both")
    compile_all(FACTORIES[name](real(precision)), [86], tmp_path)
