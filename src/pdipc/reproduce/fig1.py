"""Figure 1: Halloween party: ghosts of closed cloth on a tree in the wind, pumpkins that fall and roll."""

from pathlib import Path

from pdipc.reproduce import _snapshots


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig1.png, fig1.csv and fig1.txt, and the runs, to `out_dir`; returns the PNG. small: the bundled scene."""
    claim = "Fig. 1: ghosts hang on a tree and sway in the wind, pumpkins fall and bounce."
    return _snapshots.figure(out_dir, "fig1", ["halloween"], (0.0, 0.3, 1.0), claim, small, device, large=0.6)
