"""The CUDA code of everything a step launches compiles, whether or not the machine has a GPU (linear solvers: tests/linear)."""

import numpy as np
import pytest
import warp as wp

from pdipc.barrier import exact, friction, pairs, restitution
from pdipc.collision import bvh, candidates, islands, patches, queries, truncation
from pdipc.collision import moving_boxes as sweep
from pdipc.constraints import projector
from pdipc.device import launch as parallel
from pdipc.device.precision import real
from pdipc.integration import inertia
from pdipc.integration import loads as forces
from pdipc.linear import block_pcg, blocks, rigid_modes
from pdipc.nonlinear import anderson, local_global, newton, sums
from pdipc.paper_mode import energy_rate, printed
from pdipc.paper_mode import targets as paper

FACTORIES = {
    "step": inertia.kernels,
    "newton": newton.kernels,
    "body sums": lambda _: sums.kernels(),
    "local-global": local_global.kernels,
    "printed": printed.kernels,
    "exact barrier": exact.kernels,
    "barrier coupling": lambda precision: {"couple": exact.coupling(precision)},
    "friction": friction.kernels,
    "friction coupling": lambda precision: {"couple": friction.coupling(precision)},
    "islands": islands.kernels,
    "blocks": blocks.kernels,
    "rigid modes": rigid_modes.kernels,
    "block pcg": block_pcg.kernels,
    "flags": lambda precision: {"positive": newton._positive(precision)},
    "forces": forces.kernels,
    "reductions": lambda precision: parallel.kernels(precision),
    "scan": lambda _: parallel.scan_kernels(),
    "anderson": anderson.kernels,
    "energy_rate": energy_rate.kernels,
    "gather": projector.kernels_of,
    **{kind.__name__.rsplit(".", 1)[1]: kind.kernels for kind in projector.KINDS},
    "candidates": candidates.kernels,
    "sweep": sweep.kernels,
    "bvh": bvh.kernels,
    "patches": patches.kernels,
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


@pytest.mark.parametrize("block", [1, 4, 256])
@pytest.mark.parametrize("count", [1, 3, 255, 256, 257, 70_000])
def test_scan_in_blocks(count, block):
    """The sums that CUDA takes by its own kernels, from what each kernel does to a block of threads."""
    counts = np.random.default_rng(count).integers(0, 100, count).astype(np.int32)
    ends = wp.array(
        np.concatenate([np.cumsum(part) for part in np.split(counts, range(block, count, block))]), dtype=wp.int32, device="cpu"
    )
    kernels = parallel.scan_kernels()
    if block == 1:  # the CPU runs blocks of one thread
        ends.zero_()
        wp.launch(kernels["scan_blocks"], count, [count, wp.array(counts, device="cpu"), ends], device="cpu")
        wp.launch(kernels["scan_ends"], 1, [count, ends], device="cpu")
    else:
        host = ends.numpy()
        host[block - 1 :: block] = np.cumsum(host[block - 1 :: block])
    wp.launch(kernels["add_ends"], count, [block, ends], device="cpu")
    assert np.array_equal(ends.numpy(), np.cumsum(counts))
