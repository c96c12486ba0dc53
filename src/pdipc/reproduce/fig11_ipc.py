"""Figure 11 beside IPC (Section 7.3): the helicopters by this package and by IPC from one model, and what their steps take."""

import statistics
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pdipc.output.results import Run
from pdipc.reproduce import _beside_ipc, _common, _scenes, _snapshots
from pdipc.scene.assembly import assemble

STEPS = (6, 12, 18, 24, 30, 36)  # of the paper's size, that IPC makes, too; of the small scene it makes all
CELLS = 14  # of a helicopter of the small scene: few enough for IPC to take minutes
SHOTS = 4


def run(out_dir: str | Path, small: bool = False, device: str | None = None) -> Path:
    """Writes fig11_ipc.png, fig11_ipc.csv and fig11_ipc.txt, and the runs, to `out_dir`; returns the PNG.

    small: the bundled scene, coarser, which both run from its start to its end. At the paper's size IPC makes some of the steps, each from
    where this package's step starts.
    """
    out = Path(out_dir)
    out.mkdir(parents=True, exist_ok=True)
    scene = _beside_ipc.with_arap(
        _scenes.refined("rubber_helicopters", {"helicopter": CELLS}) if small else _scenes.rubber_helicopters()
    )
    assembly = assemble(scene)
    ours = _beside_ipc.ours(scene, out / "ours", device)
    steps = tuple(range(1, scene.simulation.steps + 1)) if small else STEPS
    theirs = _beside_ipc.theirs(scene, out / "ipc") if small else _beside_ipc.single_steps(scene, ours, steps, out / "ipc")
    crossing = {name: sum(_common.intersections(done)) for name, done in (("this package", ours), ("IPC", theirs))}
    free = ~assembly.scripted
    table, ratios, apart = [], [], []
    for k, step in enumerate(steps):
        a, b = ours.stats[step - 1], theirs.stats[k]
        apart.append(float(np.linalg.norm((ours.positions(step) - theirs.positions(k + 1))[free], axis=1).mean()))
        ratios.append(b[_beside_ipc.TIME] / a[_beside_ipc.TIME])
        both = (each[key] for key in ("outer", "converged", _beside_ipc.TIME) for each in (a, b))
        table.append((step, a["barriers"], *both, f"{apart[-1]:.3g}"))
    header = ["step", "barriers"]
    header += [f"{what} of {who}" for what in ("outer", "converged", "seconds") for who in ("this package", "IPC")]
    _common.write_table(out / "fig11_ipc.csv", (*header, "mean distance, m"), table)
    _draw(ours, theirs, steps, out / "fig11_ipc.png")
    spent = [sum(row[column] for row in table) for column in (6, 7)]
    where = f"both run all {len(steps)} steps" if small else f"steps {', '.join(map(str, steps))}, by both from the same states"
    sentence = (
        "Paper, Fig. 11 and Section 7.3: three helicopters, by IPC in 2.23 min a step on 8 cores, by its method in 3.2 s on the CPU and "
        f"65 ms on a GPU, 42 and 2,000 times faster. Here ({3 * int(free.sum())} DOF, {len(assembly.tets)} tets, as rigid as possible "
        f"by both; {where}, on one machine): IPC takes {spent[1] / len(steps):.3g} s of the processor a step, this package "
        f"{spent[0] / len(steps):.3g}; a ratio of {spent[1] / spent[0]:.0f} of the means, {statistics.median(ratios):.0f} in the median; "
        f"outer iterations {np.mean([row[3] for row in table]):.1f} and {np.mean([row[2] for row in table]):.1f}; unconverged "
        f"{sum(not row[5] for row in table)} and {sum(not row[4] for row in table)}; intersections {crossing['IPC']} and "
        f"{crossing['this package']}; {'at the end' if small else 'after a step, at most,'} vertices are "
        f"{1e3 * (apart[-1] if small else max(apart)):.2g} mm apart on average."
    )
    return _common.conclude(out / "fig11_ipc.png", sentence)


def _draw(ours: Run, theirs: Run, steps: Sequence[int], path: Path) -> None:
    """The same steps by both, under one camera."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    shown = [steps[round(part * (len(steps) - 1))] for part in np.linspace(1 / SHOTS, 1, SHOTS)]
    lines = {
        "IPC": _common.pictures(theirs, [steps.index(step) + 1 for step in shown], _snapshots.PANEL, framed=shown, beside=ours),
        "this package": _common.pictures(ours, shown, _snapshots.PANEL),
    }
    figure, axes = plt.subplots(2, SHOTS, figsize=(4 * SHOTS, 7), layout="constrained")
    for line, (name, images) in zip(axes, lines.items(), strict=True):
        for axis, step, image in zip(line, shown, images, strict=True):
            axis.imshow(image)
            axis.set_title(f"{name}, step {step}", fontsize=11)
            axis.axis("off")
    figure.savefig(path, dpi=200)
    plt.close(figure)
