"""Runs the Python of the pages on commands, pins and forces, and draws what it did: `python docs/draw_control.py [-o FOLDER] [NAME ...]`."""

import argparse
import re
import tempfile
from contextlib import ExitStack
from pathlib import Path

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import pdipc
from pdipc.pictures.render import Picture, drawing

matplotlib.use("Agg")

DOCS = Path(__file__).parent
# Of which page; words that its block of Python holds; frames; how they are drawn.
PICTURES = {
    "gripper": ("tutorial", "gripper = pdipc.Simulation", (0, 45, 110), Picture(view=(0.35, 0.3, 1.0))),
    "curtain": ("control", "curtain = {", (0, 30, 80), Picture(view=(0.25, 0.15, 1.0))),
    "stack": ("forces", 'on("low", by="floor")', (60,), Picture(view=(0.7, 0.3, 1.0), color="pressure")),
}
SIZE = (960, 720)  # pixels of a frame


def simulated(page: str, words: str, folder: Path) -> pdipc.Run:
    """The run of what a page's block simulates, as it stands there."""
    (code,) = (
        block for block in re.findall(r"```python\n(.*?)```", (DOCS / f"{page}.md").read_text(), re.DOTALL) if words in block
    )
    given = pdipc.Simulation
    with ExitStack() as recordings:

        def recorded(*arguments, **options) -> pdipc.Simulation:
            simulation = given(*arguments, **options)
            recordings.enter_context(simulation.record(folder))
            return simulation

        pdipc.Simulation = recorded
        try:
            exec(compile(code, f"{page}.md", "exec"), {"np": np, "pdipc": pdipc})
        finally:
            pdipc.Simulation = given
    return pdipc.open_run(folder)


def plot_forces(run: pdipc.Run, axis: plt.Axes) -> None:
    """The upward forces of contact on each body over time."""
    times, records = run.times[1:], [run.forces(frame) for frame in range(1, run.frame_count)]
    for name in run.body_names:
        axis.plot(times, [forces.on(name).total[1] for forces in records], label=f"on {name}")
    axis.set(xlabel="time, s", ylabel="upward force of contact, N")
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(frameon=False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("-o", "--output", type=Path, default=DOCS)
    parser.add_argument("names", nargs="*", default=list(PICTURES))
    options = parser.parse_args()
    for name in options.names:
        page, words, frames, settings = PICTURES[name]
        columns = max(len(frames), 2)
        figure, axes = plt.subplots(1, columns, figsize=(6.4 * columns, 4.8), layout="constrained")
        with tempfile.TemporaryDirectory() as folder:
            run = simulated(page, words, Path(folder) / "run")
            with drawing(run, list(frames), settings, SIZE) as drawn:  # by one camera for all
                for frame, axis in zip(frames, axes, strict=False):
                    axis.imshow(drawn.image(frame))
                    axis.set(xticks=[], yticks=[], frame_on=False)
                    axis.set_xlabel(f"{run.times[frame]:.2f} s", fontsize=15)
            if name == "stack":
                plot_forces(run, axes[1])
            met = sum(
                len(pdipc.find_intersections(run.positions(k), run.triangles, run.obstacle)) for k in range(run.frame_count)
            )
            loose = sum(not record["converged"] for record in run.stats)
            print(f"{name}: {run.frame_count} frames, {met} intersections, {loose} unconverged steps")
        figure.savefig(options.output / f"{name}.png", dpi=60)


if __name__ == "__main__":
    main()
