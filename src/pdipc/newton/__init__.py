"""pdipc as a solver of Newton, NVIDIA's simulator on Warp: `SolverPDIPC` (docs/newton.md). Needs the extra "newton"."""

try:
    import newton as _  # noqa: F401
except ImportError as error:
    raise ImportError('pdipc.newton needs the extra: pip install "pdipc[newton]"', name="newton") from error

from pdipc.newton.solver import SolverPDIPC as SolverPDIPC

__all__ = ["SolverPDIPC"]
