"""Figure 15: bone dragons fall on a cloth that is held at its corners."""

from pathlib import Path

from pdipc.reproduce import _snapshots


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig15.png, fig15.csv and fig15.txt, and the runs, to `out_dir`; returns the PNG. small: the bundled scene."""
    claim = "Fig. 15: three bone dragons, sharply concave, fall on a cloth; CCD is a must."
    return _snapshots.figure(out_dir, "fig15", ["bone_dragon"], (0.0, 0.3, 0.6, 1.0), claim, small, device)
