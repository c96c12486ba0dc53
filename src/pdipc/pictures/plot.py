"""Plots of a run's audit, with Matplotlib."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pdipc.audit import Audit
    from pdipc.output.forces import ContactForces


def plot_audits(
    audits: Sequence["Audit"], bodies: Sequence[str], contacts: "Sequence[ContactForces | None]", path: Path
) -> None:
    """Energies, momenta and the contact forces on each body over time, into `path`; None: of a frame without recorded forces."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    time = [audit.time for audit in audits]
    figure = Figure(figsize=(12, 8), layout="constrained")
    FigureCanvasAgg(figure)
    (energy, force), (linear, angular) = figure.subplots(2, 2, sharex=True)
    for name in ("kinetic", "elastic", "barrier", "gravity", "total"):
        style = {"color": "black", "linewidth": 2} if name == "total" else {}
        energy.plot(time, [getattr(audit, name) for audit in audits], label=name, **style)
    for axes, name in ((linear, "linear_momentum"), (angular, "angular_momentum")):
        for component, label in enumerate("xyz"):
            axes.plot(time, [getattr(audit, name)[component] for audit in audits], label=label)
    for body in bodies:
        force.plot(time, [np.nan if contact is None else contact.on(body).total[1] for contact in contacts], label=body)
    for axes, title in (
        (energy, "energies, J"),
        (linear, "linear momentum, kg m/s"),
        (angular, "angular momentum about the origin, kg m²/s"),
        (force, "upward contact force on each body, N"),
    ):
        axes.set_title(title)
        axes.grid(alpha=0.3)
        axes.legend(fontsize="small", ncols=2)
    for axes in (linear, angular):
        axes.set_xlabel("time, s")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
