"""Figure 4: where the lowest vertex goes during one step: truncating after each local-global iteration makes it oscillate."""

from pathlib import Path

import numpy as np

from pdipc.reproduce import _common, _iterations


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig4.csv, fig4.txt and fig4.png to `out_dir`; returns the PNG. small: a coarse ball."""
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    found = _iterations.traces(small, device)
    title = "A body hits the floor: height of its lowest vertex in the iterations of that step (dashed: outer iterations)"
    _iterations.draw(out / "fig4.png", found, "height", "height, m", title)
    _common.write_table(out / "fig4.csv", ("way", "iteration", "potential", "height", "outer"), _iterations.rows(found))
    turns = {label: int((np.diff(np.sign(np.diff(trace.height))) != 0).sum()) for label, trace in found.items()}
    told = "; ".join(f"{label}: {turns[label]} turns in {len(trace.height)} iterations" for label, trace in found.items())
    return _common.conclude(
        out / "fig4.png", f"Paper, Fig. 4: truncating too often makes the search direction oscillate. Here: {told}."
    )
