"""Figure 2: a vertex falls on a plane, under the ways to join projective dynamics with CCD that Section 4.1 goes through."""

from pathlib import Path

import numpy as np

from pdipc.reproduce import _common
from pdipc.scene.schema import Scene
from pdipc.simulation import simulate

HEIGHT, SPEED, TIME_STEP, RESTITUTION, ACTIVATION = 0.05, 2.0, 0.01, 0.5, 5e-3
LABELS = {
    "pd": "vanilla PD",
    "pd+ccd": "PD + CCD",
    "pd+ipc+ccd": "PD + IPC + CCD",
    "eq6": "proposed: Eq. (6)",
    "barrier": "barrier forces (IPC, and pdipc's default)",
}


def point(restitution: float | None, steps: int, device: str | None) -> np.ndarray:
    """(steps + 1,) m: heights of a tet of a millimetre, nearly a point, that pdipc drops in its default mode."""
    vertices = [[0, 0, 0], [1e-3, 0, 0], [0, 0, 1e-3], [3e-4, 1e-3, 3e-4]]
    body = {
        "name": "point",
        "kind": "solid",
        "mesh": {"vertices": vertices, "tets": [[0, 2, 1, 3]]},
        "translation": (0.0, HEIGHT, 0.0),
        "velocity": (0.0, -SPEED, 0.0),
        "material": {"young_modulus": 1e9, "poisson_ratio": 0.0},
    }
    scene = Scene(
        simulation={"time_step": TIME_STEP, "steps": steps, "precision": "float64", "outer_tolerance": 1e-6},
        contact={"activation_distance": ACTIVATION, "restitution": restitution},
        bodies=[body],
        obstacles=[{"name": "plane", "mesh": {"shape": "plane", "size": 1.0}}],
    )
    return np.array([HEIGHT, *(frame.positions[0, 1] for frame in simulate(scene, device=device))])


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig2.csv, fig2.txt and fig2.png to `out_dir`; returns the PNG. small: 15 steps instead of 40."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    from pdipc.baselines import projective_dynamics as plain

    out, steps = Path(out_dir), 15 if small else 40
    out.mkdir(parents=True, exist_ok=True)
    options = {"height": HEIGHT, "velocity": -SPEED, "steps": steps, "time_step": TIME_STEP, "restitution": RESTITUTION}
    heights = {
        label: plain.vertex_and_plane(method, activation=ACTIVATION, **options).heights for method, label in LABELS.items()
    }
    heights[f"pdipc, restitution {RESTITUTION:g}"] = point(RESTITUTION, steps, device)
    figure, axes = plt.subplots(2, 3, figsize=(11, 5.6), sharex=True, sharey=True, layout="constrained")
    milliseconds = 1e3 * TIME_STEP * np.arange(steps + 1)
    for number, (axis, (label, height)) in enumerate(zip(axes.ravel(), heights.items(), strict=True)):
        axis.axhspan(-20, 0, color="0.85")
        axis.axhline(1e3 * ACTIVATION, color="0.6", linewidth=0.8, linestyle=":")
        axis.plot(milliseconds, 1e3 * height, "o-", markersize=3, color=f"C{number}")
        axis.set_title(label, fontsize=10)
    axes[0, 0].set_ylim(-12, 68)
    for axis in axes[-1]:
        axis.set_xlabel("time, ms")
    for axis in axes[:, 0]:
        axis.set_ylabel("height, mm")
    figure.suptitle(f"A vertex falls on a plane at {SPEED:g} m/s; dotted: activation distance")
    figure.savefig(out / "fig2.png", dpi=110)
    plt.close(figure)
    rows = [(label, step, height) for label, values in heights.items() for step, height in enumerate(values)]
    _common.write_table(out / "fig2.csv", ("method", "step", "height"), rows)
    lowest = {label: values.min() for label, values in heights.items()}
    after = {label: values[6:].max() for label, values in heights.items()}
    told = "; ".join(
        f"{label}: lowest {1e3 * lowest[label]:.2g} mm, then up to {1e3 * after[label]:.1f} mm" for label in heights
    )
    return _common.conclude(
        out / "fig2.png",
        "Paper, Fig. 2: vanilla PD passes the plane and springs back, CCD after each solve sticks, adding the barrier does not help, "
        f"Eq. (6) rebounds. Here: {told}.",
    )
