"""Figure 14: a skirt of several layers on a dancing body."""

from pathlib import Path

from pdipc.reproduce import _snapshots


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig14.png, fig14.csv and fig14.txt, and the runs, to `out_dir`; returns the PNG. small: the bundled scene."""
    claim = "Fig. 14: the layers of the skirt never pass each other or the body."
    return _snapshots.figure(out_dir, "fig14", ["skirt"], (0.0, 0.3, 0.6, 1.0), claim, small, device)
