"""Figure 13: a dragon is dragged and let go; two cloths fall on the Armadillo and all are dragged."""

from pathlib import Path

from pdipc.reproduce import _snapshots


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig13.png, fig13.csv and fig13.txt, and the runs, to `out_dir`; returns the PNG. small: the bundled scenes."""
    claim = "Fig. 13: dragged at will, dragon and Armadillo never interpenetrate."
    return _snapshots.figure(out_dir, "fig13", ["dragon", "armadillo"], (0.0, 0.29, 0.58, 1.0), claim, small, device)
