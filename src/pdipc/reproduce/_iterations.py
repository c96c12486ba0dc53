"""What happens inside one step (Figures 4 and 5): potential and place after every local-global iteration, three ways."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import warp as wp

from pdipc.barrier.potential import EXTENSION
from pdipc.drive import step
from pdipc.integration import status
from pdipc.model import Model, State, build
from pdipc.nonlinear.local_global import LocalGlobal
from pdipc.paper_mode import energy_rate
from pdipc.paper_mode.printed import Printed
from pdipc.reproduce import _common
from pdipc.scene.schema import Scene
from pdipc.work import Work

WAYS = {
    "truncated after each L-G iteration": {"method": "paper", "inner_iterations": 1},
    "two levels (Algorithm 1)": {"method": "paper", "inner_iterations": 30},
    "default mode": {"method": "barrier", "inner_iterations": 30},
}


@dataclass
class Trace:
    """potential: J, and height: m, of the lowest vertex, after each iteration; outer: at which iterations an outer one ended.

    stopped: the iteration at which the mode's own test ends the step. The paper's modes are followed beyond it.
    """

    potential: list[float] = field(default_factory=list)
    height: list[float] = field(default_factory=list)
    outer: list[int] = field(default_factory=list)
    stopped: int | None = None


class Watched(Work):
    """A step that is not recorded, and is looked at after each iteration; as printed, its test is only noted."""

    def __init__(self, model: Model):
        super().__init__(model, recorded=False)
        self.trace, self.lowest = Trace(), 0
        method = self.method
        assert isinstance(method, LocalGlobal | Printed)
        method._local_global = self._seen(method._local_global, self._after_local_global)
        method.accept = self._seen(method.accept, self._after_outer)

    @staticmethod
    def _seen(launches: Callable[[], None], after: Callable[[], None]) -> Callable[[], None]:
        def both() -> None:
            launches()
            after()

        return both

    def start_clock(self) -> None:
        """As `Work.start_clock`; a step that is taken again, since a list was full, is told from the beginning."""
        super().start_clock()
        self.trace = Trace()

    def _after_local_global(self) -> None:
        self.trace.potential.append(potential(self))
        self.trace.height.append(float((self.x_start.numpy() + self.u_tilde.numpy())[self.lowest, 1]))

    def _after_outer(self) -> None:
        """Notes where it ended."""
        self.trace.outer.append(len(self.trace.potential))
        count = self.count.numpy()
        if count[status.STATUS] != status.CONVERGED:
            return
        if self.trace.stopped is None:
            self.trace.stopped = len(self.trace.potential)
        settings = self.model.settings
        if settings.method == "paper" and count[status.OUTER] < settings.max_outer:
            self.going.fill_(1)


def potential(work: Work) -> float:
    """E + Psi + B at the iterate, J, with the barriers of the outer iteration: what the inner loop is meant to lower.

    As printed B is that of the position targets. In the default mode it is Eq. (4) in each pair's linearized gap, and below half
    of the gap at the start of the outer iteration a parabola: iterates may be past contact.
    """
    method = work.method
    if isinstance(method, Printed):
        return float(method.loop.energies.numpy()[energy_rate.TOTAL])
    model, h = work.model, work.model.settings.time_step
    x, z, start = (np.asarray(array.numpy()) for array in (work.u_tilde, work.z, work.u))
    inertia = 0.5 * float((model.mass.numpy()[:, None] * (x - z) ** 2).sum()) / h**2
    elastic = wp.zeros(1, dtype=model.real.scalar, device=model.device.warp)
    model.projector.energy(work.x_start, work.u_tilde, elastic, 0)
    p = work.pairs
    count = int(p.count.numpy()[0])
    quads, a, n, gap, d_hat, stiffness = (
        np.asarray(array.numpy()[:count]) for array in (p.quads, p.weights, p.normals, p.gaps, p.activation, p.stiffness)
    )
    delta = gap + (n * (a[:, :, None] * (x - start)[quads]).sum(axis=1)).sum(axis=1)
    at = np.clip(np.maximum(delta, EXTENSION * gap), None, d_hat)
    s, log = at - d_hat, np.log(at / d_hat)
    past = np.minimum(delta - at, 0.0)
    barrier = -s * s * log + (-2 * s * log - s * s / at) * past + 0.5 * (-2 * log - 4 * s / at + (s / at) ** 2) * past**2
    return inertia + float(elastic.numpy()[0]) + float((stiffness * barrier).sum())


def scene(small: bool, method: str, inner_iterations: int) -> Scene:
    """A body in free fall, 2 m/s, just above the floor: the bunny of the optional data, else a ball."""
    path = None if small else _common.data("meshes/tet/bunny_7k.npz")
    mesh = {"shape": "sphere", "radius": 0.5, "cells": 4 if small else 10}
    if path:
        arrays = np.load(path)
        size = np.ptp(arrays["V"], axis=0).max()
        mesh = {"vertices": arrays["V"] / size, "tets": arrays["T"]}
    body = {
        "name": "body",
        "kind": "solid",
        "mesh": mesh,
        "velocity": (0.0, -2.0, 0.0),
        "translation": (0.0, 2.0, 0.0),
        "material": {"young_modulus": 2e5, "poisson_ratio": 0.3, "density": 1000.0},
    }
    return Scene(
        simulation={
            "precision": "float64",
            "nonlinear_solver": "auto" if method == "paper" else "local-global",
            "inner_iterations": inner_iterations,
            "max_outer": 12 if small else 30,
        },
        contact={"method": method, "activation_distance": 5e-3, "stiffness_scale": 100.0},
        bodies=[body],
        obstacles=[{"name": "floor", "mesh": {"shape": "plane", "size": 6.0}}],
    )


def traces(small: bool, device: str | None) -> dict[str, Trace]:
    """The step in which the body hits the floor, from the same state, in the three ways."""
    found, arrays = {}, None
    with _common.progress("one step, three ways", len(WAYS)) as advance:
        for number, (label, options) in enumerate(WAYS.items()):
            model = build(scene(small, **options), device)
            if arrays is None:
                arrays = _above_the_floor(model)
            work = Watched(model)
            work.lowest = int(np.argmin(np.where(model.free.numpy() > 0, arrays["positions"][:, 1], np.inf)))
            step(model, model.state_from(arrays), work)
            found[label] = work.trace
            advance(number + 1, label)
    return found


def _above_the_floor(model: Model) -> dict:
    """The initial state, lowered so that the lowest vertex is half a step's way above the floor."""
    state: State = model.initial_state()
    arrays, free = state.arrays(), model.free.numpy() > 0
    arrays["positions"][free, 1] -= arrays["positions"][free, 1].min() - 0.01
    return arrays


def rows(found: dict[str, Trace]) -> list[tuple]:
    """For a CSV: way, iteration, potential, height, whether an outer iteration ended there."""
    return [
        (label, k + 1, trace.potential[k], trace.height[k], int(k + 1 in trace.outer))
        for label, trace in found.items()
        for k in range(len(trace.potential))
    ]


def draw(path: Path, found: dict[str, Trace], what: str, unit: str, title: str) -> None:
    """One panel a way: `what` ("potential" or "height") over iterations; dashed lines where outer iterations end."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(12, 4), sharey=True, layout="constrained")
    for axis, (label, trace) in zip(axes, found.items(), strict=True):
        values = np.array(getattr(trace, what))
        for end in trace.outer[:-1]:
            axis.axvline(end + 0.5, color="C3", linewidth=0.6, linestyle="--", alpha=0.6)
        axis.plot(np.arange(1, len(values) + 1), values, "o-", markersize=2.5, linewidth=1)
        if trace.stopped:
            axis.axvline(trace.stopped, color="k", linewidth=1.2, label="its own test ends the step")
            axis.legend(fontsize=8)
        axis.set_title(label, fontsize=10)
        axis.set_xlabel("L-G iteration")
    axes[0].set_ylabel(unit)
    if what == "potential":
        axes[0].set_yscale("log")
        axes[0].set_ylim(bottom=0.2 * min(trace.potential[-1] for trace in found.values()))  # free flight has next to none
    figure.suptitle(title)
    figure.savefig(path, dpi=110)
    plt.close(figure)
