"""Figure 5: total potential E + Psi + B over the iterations of the step in which a body hits the floor."""

from pathlib import Path

from pdipc.reproduce import _common, _iterations


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig5.csv, fig5.txt and fig5.png to `out_dir`; returns the PNG. small: a coarse ball."""
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    found = _iterations.traces(small, device)
    title = "A body hits the floor: total potential over the iterations of that step (dashed: outer iterations)"
    _iterations.draw(out / "fig5.png", found, "potential", "E + Ψ + B, J", title)
    _common.write_table(out / "fig5.csv", ("way", "iteration", "potential", "height", "outer"), _iterations.rows(found))
    told = "; ".join(
        f"{label}: {trace.potential[trace.stopped - 1]:.4g} J where its test ends the step, after {trace.stopped} iterations"
        if trace.stopped
        else f"{label}: never ended, {trace.potential[-1]:.4g} J after {len(trace.potential)} iterations"
        for label, trace in found.items()
    )
    return _common.conclude(
        out / "fig5.png",
        "Paper, Fig. 5: with CCD after each iteration the potential oscillates and hardly converges; with two levels it falls within each "
        f"outer iteration and settles. Here: {told}.",
    )
