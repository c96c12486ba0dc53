"""Figure 16: animals fall on rubber straps."""

from pathlib import Path

from pdipc.reproduce import _snapshots


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig16.png, fig16.csv and fig16.txt, and the runs, to `out_dir`; returns the PNG. small: the bundled scene."""
    claim = "Fig. 16: animals fall on rubber straps and pull a couple of them to the floor."
    return _snapshots.figure(out_dir, "fig16", ["animals"], (0.0, 0.3, 0.6, 1.0), claim, small, device)
