"""The CUDA code of all linear kernels compiles, whether or not the machine has a GPU."""

import pytest
import warp as wp

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


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", FACTORIES)
def test_compiles(name, precision, tmp_path):
    """To machine code for one architecture, which also checks the limit on shared memory."""
    found = vars(FACTORIES[name](real(precision))).values()
    for module in {kernel.module for kernel in found if isinstance(kernel, wp.Kernel)}:
        for binary in wp.compile_aot_module(module, arch=86, module_dir=tmp_path, use_ptx=False):
            assert binary.stat().st_size > 1000
