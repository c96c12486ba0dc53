"""CUDA machine code of a module's kernels, on a machine that need not have a GPU."""

import os
from collections.abc import Iterable
from pathlib import Path

import pytest
import warp as wp
from factories import modules

EVERYTHING = bool(os.environ.get("PDIPC_ALL_ARCHITECTURES"))  # all modules in both precisions, optimized as they run


def compile_all(made: object, architectures: Iterable[int], folder: Path) -> None:
    """Compiles the modules of the kernels that a factory made, and sees that each gives code for each architecture.

    Without EVERYTHING nothing is optimized: that takes more than half of the time and finds no errors.
    """
    found = modules(made)
    assert found
    for module in found:
        with pytest.MonkeyPatch.context() as patched:
            if not EVERYTHING:
                patched.setitem(module.options, "optimization_level", 0)
            module.mark_modified()
            for binary in wp.compile_aot_module(module, arch=architectures, module_dir=folder, use_ptx=False):
                assert binary.stat().st_size > 1000
        module.mark_modified()
