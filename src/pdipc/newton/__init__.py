"""pdipc as a solver of Newton, NVIDIA's simulator on Warp: `SolverPDIPC` (docs/newton.md). Needs the extra "newton"."""

from pdipc.newton.solver import SolverPDIPC as SolverPDIPC

__all__ = ["SolverPDIPC"]
