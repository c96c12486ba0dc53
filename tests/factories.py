"""The factories of all kernels, by what they are for: each takes a precision and makes what has kernels of one module, or of a few."""

import warp as wp

from pdipc.barrier import exact, friction, pairs, restitution
from pdipc.collision import bvh, candidates, islands, patches, queries, truncation
from pdipc.collision import moving_boxes as sweep
from pdipc.constraints import projector
from pdipc.device import launch as parallel
from pdipc.device import sums
from pdipc.integration import inertia, script
from pdipc.integration import loads as forces
from pdipc.linear import (
    affine,
    block_pcg,
    blocks,
    coarse,
    kernels,
    pcg,
    rigid_modes,
    translations,
    wide_modes,
    wide_pcg,
)
from pdipc.linear.paper import a_jacobi as aggregated
from pdipc.linear.paper import gauss_seidel, jacobi, powers
from pdipc.nonlinear import anderson, descent, local_global, newton
from pdipc.paper_mode import energy_rate, printed
from pdipc.paper_mode import targets as paper

STEP = {
    "step": inertia.kernels,
    "script": script.kernels,
    "newton": newton.kernels,
    "descent": descent.kernels,
    "body sums": lambda _: sums.kernels(),
    "local-global": local_global.kernels,
    "printed": printed.kernels,
    "exact barrier": exact.kernels,
    "contact rows": lambda precision: {"a": exact.assembly(precision), "b": friction.assembly(precision)},
    "barrier coupling": lambda precision: {"couple": exact.coupling(precision)},
    "friction": friction.kernels,
    "friction coupling": lambda precision: {"couple": friction.coupling(precision)},
    "islands": islands.kernels,
    "blocks": blocks.kernels,
    "rigid modes": rigid_modes.kernels,
    "block pcg": block_pcg.kernels,
    "wide modes": wide_modes.kernels,
    "wide couplings": lambda precision: {"a": exact.wide_coupling(precision), "b": friction.wide_coupling(precision)},
    "wide pcg": lambda precision: wide_pcg.kernels(precision, exact.operator(precision), friction.operator(precision)),
    "affine": affine.kernels,
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
LINEAR = {
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


def modules(made: object) -> set[wp.Module]:
    """Of the kernels that a factory made."""
    found = (made if isinstance(made, dict) else vars(made)).values()
    return {kernel.module for kernel in found if isinstance(kernel, wp.Kernel)}


BLOCKS = {
    "wide couplings",
    "wide modes",
    "wide pcg",
    "a-jacobi in groups",
    "matrix powers",
    "scan",
    "bvh",
}  # few tests or none use these there
ON_CPU = {name: factory for name, factory in {**STEP, **LINEAR}.items() if name not in BLOCKS}
