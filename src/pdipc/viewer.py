"""Watching in the browser (viser, an extra): play a run back, or simulate a scene live and pull at it."""

import threading
import time
from typing import Any

import numpy as np

PALETTE = ((228, 120, 60), (70, 120, 190), (110, 170, 90), (200, 90, 120), (150, 120, 190), (220, 180, 70))
GREY = (185, 185, 190)


class View:
    """The surfaces of all bodies on a web page, one mesh a body."""

    def __init__(self, triangles: np.ndarray, body_of_vertex: np.ndarray, kinds: list[str], positions: np.ndarray, port: int):
        import viser

        self.server = viser.ViserServer(port=port, verbose=False)
        self.server.scene.set_up_direction("+y")
        self.parts = []
        of_triangle = body_of_vertex[triangles[:, 0]]
        for body, kind in enumerate(kinds):
            mine = triangles[of_triangle == body]
            vertices, local = np.unique(mine, return_inverse=True)
            color = GREY if kind == "obstacle" else PALETTE[body % len(PALETTE)]
            self.parts.append((body, vertices, local.reshape(-1, 3), color))
        self.show(positions)

    def show(self, positions: np.ndarray) -> None:
        """Shows all bodies at positions (n, 3), m."""
        with self.server.atomic():
            for body, vertices, local, color in self.parts:
                self.server.scene.add_mesh_simple(
                    f"/body{body}", positions[vertices].astype(np.float32), local, color=color, side="double"
                )


def play(run: Any, port: int = 8080, block: bool = True) -> View:
    """Plays a run, from `pdipc.open_run`, with a slider. block: serve until Ctrl-C."""
    topology = run.topology
    view = View(run.triangles, np.asarray(topology["body_of_vertex"]), list(topology["body_kinds"]), run.positions(0), port)
    frame = view.server.gui.add_slider("frame", min=0, max=max(1, run.frame_count - 1), step=1, initial_value=0)
    playing = view.server.gui.add_checkbox("play", initial_value=True)
    frame.on_update(lambda _: view.show(run.positions(min(frame.value, run.frame_count - 1))))

    def advance() -> None:
        while True:
            time.sleep(1 / 30)
            if playing.value and run.frame_count > 1:
                frame.value = (frame.value + 1) % run.frame_count

    threading.Thread(target=advance, daemon=True).start()
    return _serve(view, block)


def simulate(scene: Any, port: int = 8080, device: str | None = None, block: bool = True) -> View:
    """Simulates a scene live, with pause, reset and a handle that pulls the vertex nearest to it. block: serve until Ctrl-C."""
    from pdipc.simulate import Simulation

    simulation = Simulation(scene, device)
    assembly = simulation.model.assembly
    kinds = [body.kind for body in assembly.bodies]
    view = View(simulation.triangles, assembly.body_of_vertex, kinds, simulation.positions, port)
    gui = view.server.gui
    running = gui.add_checkbox("run", initial_value=True)
    pull = gui.add_slider("pull, N", min=0.0, max=100.0, step=0.1, initial_value=0.0)
    reset = gui.add_button("reset")
    report = gui.add_markdown("")
    free = np.flatnonzero(~assembly.scripted)
    top = free[np.argmax(simulation.positions[free, 1])]
    handle = view.server.scene.add_transform_controls(
        "/handle", scale=0.1 * assembly.scene_size, position=tuple(simulation.positions[top])
    )
    asked = {"reset": False}
    reset.on_click(lambda _: asked.update(reset=True))

    def advance() -> None:
        while True:
            if asked["reset"]:
                asked["reset"] = False
                simulation.reset()
                view.show(simulation.positions)
            if not running.value:
                time.sleep(0.02)
                continue
            positions = simulation.positions
            away = np.asarray(handle.position) - positions[free]
            near = free[np.argmin((away**2).sum(axis=1))]
            direction = np.asarray(handle.position) - positions[near]
            length = np.linalg.norm(direction)
            force = pull.value * direction / length if length > 0 else np.zeros(3)
            simulation.set_vertex_force(np.array([near]), force[None])
            result = simulation.step()
            view.show(simulation.positions)
            report.content = (
                f"time {simulation.state.time:.2f} s, outer iterations {result.outer}, contacts {result.barriers}, "
                f"{sum(result.milliseconds.values()):.0f} ms a step"
            )

    threading.Thread(target=advance, daemon=True).start()
    return _serve(view, block)


def _serve(view: View, block: bool) -> View:
    if block:
        print(f"open http://localhost:{view.server.get_port()} in a browser; Ctrl-C ends")
        try:
            while True:
                time.sleep(1.0)
        except KeyboardInterrupt:
            view.server.stop()
    return view
