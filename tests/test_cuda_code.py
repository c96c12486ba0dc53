"""The CUDA code of everything a step launches compiles, whether or not the machine has a GPU (linear solvers: tests/linear)."""

import pytest
import warp as wp

from pdipc import anderson, energy_rate, forces, parallel
from pdipc.constraints import projector
from pdipc.contact import bvh, candidates, pairs, paper, patches, queries, restitution, sweep, truncation
from pdipc.precision import real
from pdipc.step import kernels as step_kernels

FACTORIES = {
    "step": step_kernels,
    "forces": forces.kernels,
    "reductions": lambda precision: parallel.kernels(precision),
    "anderson": anderson.kernels,
    "energy_rate": energy_rate.kernels,
    "gather": projector.kernels,
    **{kind.__name__.rsplit(".", 1)[1]: kind.kernels for kind in projector.KINDS},
    "candidates": candidates.kernels,
    "sweep": sweep.kernels,
    "bvh": lambda _: bvh.kernels(),
    "patches": lambda _: patches.kernels(),
    "pairs": pairs.kernels,
    "paper": paper.kernels,
    "restitution": restitution.kernels,
    "truncation": truncation.kernels,
    "time of impact": queries.kernels,
}


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("name", FACTORIES)
def test_compiles(name, precision, tmp_path):
    """To machine code for one architecture."""
    made = FACTORIES[name](real(precision))
    found = (made if isinstance(made, dict) else vars(made)).values()
    modules = {kernel.module for kernel in found if isinstance(kernel, wp.Kernel)}
    assert modules
    for module in modules:
        for binary in wp.compile_aot_module(module, arch=86, module_dir=tmp_path, use_ptx=False):
            assert binary.stat().st_size > 1000
