"""What came of a run, in words."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pdipc.output.results import Run


def metres(length: float | None) -> str:
    """A length for people: "1.20 mm"; "none" where it is None or infinite."""
    if length is None or length == float("inf"):
        return "none"
    for unit, size in (("m", 1.0), ("mm", 1e-3), ("um", 1e-6)):
        if abs(length) >= size:
            return f"{length / size:.3g} {unit}"
    return f"{length / 1e-9:.3g} nm"


def smallest_gap(done: "Run") -> float | None:
    """m, of all steps; None without contact."""
    return min((record["smallest_gap"] for record in done.stats if record.get("smallest_gap") is not None), default=None)


def told_of(opened: "Run", steps: int) -> Iterator[str]:
    """Lines about a run: time, convergence, contact, machine, versions."""
    stats, meta = opened.stats, opened.meta
    yield f"{opened.frame_count} frames, {opened.times[-1] if opened.frame_count else 0:g} s; {len(stats)} of {steps} steps done"
    spent = sorted(sum(record["milliseconds"].values()) for record in stats if record.get("milliseconds"))
    if spent:
        yield f"{sum(spent) / 1e3:.3g} s of work, median {spent[len(spent) // 2]:.3g} ms a step, longest {spent[-1]:.3g} ms"
    judged = [record["converged"] for record in stats if "converged" in record]
    if judged:
        worst = max((record["residual"] for record in stats if record.get("residual") is not None), default=None)
        told = "unknown" if worst is None else metres(worst)
        share = 100.0 * sum(judged) / len(judged)
        yield f"{share:.4g} % of the steps converged ({len(judged) - sum(judged)} did not), worst residual {told}"
    contacts = [record["barriers"] for record in stats if "barriers" in record]
    if contacts:
        yield f"smallest gap {metres(smallest_gap(opened))}, at most {max(contacts)} contacts"
    on = [f"{meta[name]}" for name in ("device", "precision", "machine") if name in meta]
    if "threads" in meta:
        on.insert(1, f"{meta['threads']} threads")
    yield "made on " + ", ".join(on)
    versions = ("pdipc", "warp-lang", "numpy", "python")
    yield "with " + ", ".join(f"{name} {meta[name]}" for name in versions if name in meta)
    rest = {
        name: value
        for name, value in meta.items()
        if value and name not in {*versions, "format", "device", "precision", "machine", "threads"}
    }
    if rest:
        yield ", ".join(f"{name} {value}" for name, value in rest.items())
