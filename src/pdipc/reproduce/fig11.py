"""Figure 11: rubber helicopters collide in a glass tank."""

from pathlib import Path

from pdipc.reproduce import _snapshots


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig11.png, fig11.csv and fig11.txt, and the runs, to `out_dir`; returns the PNG. small: the bundled scene."""
    claim = "Fig. 11: three rubber helicopters collide in a tank without interpenetration."
    return _snapshots.figure(out_dir, "fig11", ["helicopters"], (0.0, 0.25, 0.6, 1.0), claim, small, device)
