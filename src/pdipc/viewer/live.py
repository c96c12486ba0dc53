"""A scene that is simulated while it is watched, and whose bodies are dragged."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.output.results import RunError
from pdipc.scene.errors import SceneError
from pdipc.scene.load import load_scene
from pdipc.scene.looks import looks
from pdipc.simulation import Simulation
from pdipc.viewer.engine import Engine, Shot
from pdipc.viewer.grip import Grip
from pdipc.viewer.stage import HOST, PLOTTED, PORT, Plot, Stage, badge, told

REFRESHED = 1.0 / 30.0  # s between two looks of the page's loop
PLOT_EVERY = 0.3  # s between two updates of the plots
LOOK_EVERY = 0.5  # s between two looks at the scene's file
NOW = "newest"
LOOKS: Any = {part: {"__all__": {"name", "look"}} for part in ("bodies", "obstacles")}


class Live:
    """A scene simulated live, no faster than the speed that is chosen: run, pause, one step, reset; a time line of the frames so far;
    dragging a body pulls what is under the mouse towards it. Gravity and friction can be changed while it runs.

    device: see `pdipc.build`. record: a new run folder that everything is written to. watched: the scene's file, which is read again,
    and started anew, when it has been saved. Raises SceneError for a scene that cannot be simulated.
    """

    def __init__(
        self,
        scene: Any,
        host: str = HOST,
        port: int = PORT,
        device: str | None = None,
        origins: Sequence[str] = (),
        record: str | Path | None = None,
        watched: str | Path | None = None,
    ):
        self.held: Grip | None = None
        self.point = np.zeros(3)  # where the mouse is, m
        self.down = _down(scene)
        self.engine = Engine(scene, device, self._pull)
        self.view = Stage(*self._surfaces(), host, port, origins, **self._told_of_bodies(), picture=scene.picture)
        self.view.listen(lambda body, event: self._dragging(body, event))
        self._panel(scene, record)
        self.watched = None if watched is None else Path(watched)
        self._saved = self._saved_at()
        self._shown: Shot | None = None
        self._top = 1e-9  # Pa, of the last colour
        self._plotted = self._looked = 0.0
        if record is not None:
            self.engine.record(record)
            self.recording.value = True

    # what scripts and tests reach
    @property
    def simulation(self) -> Simulation:
        """The one that is running."""
        return self.engine.simulation

    def _surfaces(self) -> tuple[np.ndarray, np.ndarray, list[str], np.ndarray, np.ndarray]:
        assembly = self.simulation.model.assembly
        kinds = [body.kind for body in assembly.bodies]
        radii = assembly.topology()["body_radii"]
        return self.simulation.triangles, assembly.body_of_vertex, kinds, radii, self.simulation.positions

    def _told_of_bodies(self) -> dict[str, Any]:
        names = [body.name for body in self.simulation.model.assembly.bodies]
        return {"names": names, "looks": looks(self.engine.scene.model_dump(include=LOOKS), names)}

    def _panel(self, scene: Any, record: str | Path | None) -> None:
        gui, engine = self.view.server.gui, self.engine
        self.state = gui.add_html(badge({}))
        self.report = gui.add_markdown(told(0.0, {}))
        with gui.add_folder("simulation"):
            self.running = gui.add_checkbox("run", initial_value=True)
            buttons = gui.add_button_group("", ("step", "reset"))
            self.speed = gui.add_slider("speed", min=0.1, max=10.0, step=0.1, initial_value=1.0, hint="1 is real time")
            gravity = float(np.linalg.norm(scene.simulation.gravity))
            self.gravity = gui.add_slider(
                "gravity",
                min=0.0,
                max=max(20.0, 2 * gravity),
                step=0.01,
                initial_value=gravity,
                hint="m/s^2, along the scene's",
            )
            paper = scene.contact.method == "paper"  # which has no friction
            self.friction = gui.add_slider(
                "friction",
                min=0.0,
                max=max(1.5, scene.contact.friction),
                step=0.01,
                initial_value=scene.contact.friction,
                disabled=paper,
                hint="of bodies without their own",
            )
        with gui.add_folder("time line"):
            self.frame = gui.add_slider("frame", min=0, max=1, step=1, initial_value=0)
            self.playing = gui.add_dropdown("show", (NOW, "frame", "play"), initial_value=NOW)
        with gui.add_folder("plots", expand_by_default=False):
            self.energies = Plot(gui, "energies, J", ("kinetic", "elastic", "contact", "gravity"))
            self.residuals = Plot(gui, "residual, log10 of m", ("residual",), log=True)
        self.color = self.view.add_view_panel()
        engine.wants_pressure = self.color.value == "pressure"
        with gui.add_folder("record", expand_by_default=False):
            self.folder = gui.add_text("folder", str(record or "runs/live"))
            self.recording = gui.add_checkbox(
                "record", initial_value=False, hint="all frames since the start, and those to come"
            )
            self.recorded = gui.add_markdown("")
        gui.add_markdown("Drag a body to pull at it, the background to turn the view.")

        def settings(_: Any = None) -> None:
            engine.running, engine.speed = self.running.value, self.speed.value
            engine.wants_pressure = self.color.value == "pressure"

        for handle in (self.running, self.speed, self.color):
            handle.on_update(settings)
        for handle in (self.gravity, self.friction):
            handle.on_update(lambda _: self._change())
        buttons.on_click(lambda _: engine.ask(self.step if buttons.value == "step" else self.reset))
        self.frame.on_update(self._chosen)
        self.recording.on_update(lambda event: None if event.client is None else engine.ask(self._record))
        self._changing = False

    def _chosen(self, event: Any) -> None:
        """Somebody chose a frame: it stays."""
        if event.client is not None:
            self.playing.value = "frame"

    # --- what the page asks for; done between two steps ---

    def _dragging(self, body: int, event: Any) -> None:
        self.engine.ask(lambda: self.drag(body, event.phase, event.start_position, event.end_position))

    def drag(self, body: int, phase: str, start: Any, end: Any) -> None:
        """Takes hold of the free vertex of `body` nearest to the point `start`, m, and of those around it, on phase "start"; leads
        them to `end`, m; and lets go on phase "end". A body without free vertices stays as it is.
        """
        self.point = np.array(end, dtype=np.float64)
        if phase == "start":
            self.held = Grip.at(self.simulation, body, np.asarray(start))
        elif phase == "end":
            self.held = None

    def _pull(self, simulation: Simulation) -> None:
        """What the mouse does to the next step."""
        if self.held is None:
            simulation.set_vertex_force(np.zeros(0), np.zeros((0, 3)))
        else:
            simulation.set_vertex_force(self.held.vertices, self.held.forces(simulation, self.point))

    def step(self) -> None:
        """One step, with the pull of the mouse."""
        self.engine.step()

    def reset(self) -> None:
        """Back to the start, with nothing held."""
        self.held = None
        self.engine.reset()

    def _change(self) -> None:
        """Asks for the gravity and friction of the sliders; a slider that is moved on asks once."""
        if not self._changing:
            self._changing = True
            self.engine.ask(self.apply)

    def apply(self) -> None:
        """Goes on with the gravity and friction of the sliders."""
        self._changing = False
        scene = self.engine.scene
        gravity = tuple(float(part) for part in self.gravity.value * self.down)
        if np.allclose(gravity, scene.simulation.gravity, atol=1e-9) and self.friction.value == scene.contact.friction:
            return
        simulation = scene.simulation.model_copy(update={"gravity": gravity})
        contact = scene.contact.model_copy(update={"friction": float(self.friction.value)})
        self.engine.build(scene.model_copy(update={"simulation": simulation, "contact": contact}), keep_state=True)

    def _record(self) -> None:
        try:
            if self.recording.value:
                self.engine.record(self.folder.value)
                self.recorded.content = f"recording into {self.folder.value}"
            else:
                self.engine.stop_recording()
                self.recorded.content = f"recorded into {self.folder.value}"
        except (RunError, ValueError, OSError) as error:
            self.recording.value = False
            self.recorded.content = f"**not recorded:** {error}"

    def _reload(self) -> None:
        """Starts the scene anew as its file says now; keeps the old one where that is wrong."""
        try:
            scene = load_scene(self.watched)  # pyright: ignore[reportArgumentType]
            self.engine.build(scene)
        except SceneError as error:
            self.state.content = badge({}, f"the saved scene is wrong, the old one goes on: {error}")
            return
        self.held, self.down = None, _down(scene)
        self.gravity.value, self.friction.value = float(np.linalg.norm(scene.simulation.gravity)), scene.contact.friction
        self.view.picture = scene.picture
        self.view.build(*self._surfaces(), **self._told_of_bodies())
        self.view.list_bodies()

    # --- the page's loop ---

    def advance(self) -> None:
        """Does what was asked for, takes a step where it runs, and shows it: what the two threads do, one after the other."""
        self.engine.running = self.running.value
        self.engine.advance()
        self.refresh()

    def refresh(self) -> None:
        """Shows the frame that the time line says."""
        shots, now = self.engine.frames, time.monotonic()
        if shots[-1].step > 0:
            self.frame.max = max(1, shots[-1].step)
        if self.playing.value == NOW:
            shot = shots[-1]
        else:
            if self.playing.value == "play":
                self.frame.value = (
                    min(self.frame.value + 1, shots[-1].step) if self.frame.value < shots[-1].step else shots[0].step
                )
            shot = shots[int(np.clip(self.frame.value - shots[0].step, 0, len(shots) - 1))]
        if shot is not self._shown:
            self._show(shot)
        if now - self._plotted > PLOT_EVERY:
            self._plotted = now
            last = shots[-PLOTTED:]
            energetic = [each for each in last if each.energies is not None]
            self.energies.show([each.time for each in energetic], [each.energies for each in energetic])  # pyright: ignore[reportArgumentType]
            solved = [each for each in last if each.record.get("residual")]
            self.residuals.show([each.time for each in solved], [(each.record["residual"],) for each in solved])
        if self.watched is not None and now - self._looked > LOOK_EVERY:
            self._looked = now
            saved = self._saved_at()
            if saved is not None and saved != self._saved:
                self._saved = saved
                self.engine.ask(self._reload)

    def _show(self, shot: Shot) -> None:
        pressure = shot.pressure if self.color.value == "pressure" else None
        if pressure is not None:
            pressure = np.where(self.simulation.model.assembly.obstacle, 0.0, pressure)
            self._top = (
                max(self._top, float(np.quantile(pressure[pressure > 0.0], 0.99))) if (pressure > 0.0).any() else self._top
            )
        elif self.color.value == "pressure":
            pressure = np.zeros(len(shot.positions))
        self.view.show(shot.positions, pressure, self._top)
        scale = f", colors to {self._top:.3g} Pa" if pressure is not None and self._top > 1e-9 else ""
        self.state.content = badge(shot.record, f"{self.engine.rate:.1f} steps/s{scale}")
        self.report.content = told(shot.time, shot.record)
        if self.playing.value == NOW:
            self.frame.value = shot.step
        self._shown = shot

    def _saved_at(self) -> int | None:
        try:
            return None if self.watched is None else self.watched.stat().st_mtime_ns
        except OSError:  # while an editor replaces it
            return None

    def loop(self, over: Callable[[], bool] = lambda: False) -> None:
        """Simulates and shows until `over()` or an exception such as KeyboardInterrupt; raises what ended the simulation."""
        self.engine.start()
        while not over():
            if self.engine.error is not None:
                self.report.content = f"**The simulation ended:** {self.engine.error}"
                raise self.engine.error
            self.refresh()
            time.sleep(REFRESHED)

    def close(self) -> None:
        """Ends the simulation, the recording and the page."""
        self.engine.close()
        self.view.close()


def _down(scene: Any) -> np.ndarray:
    """(3,) unit vector along the scene's gravity; along -y where there is none."""
    gravity = np.array(scene.simulation.gravity)
    length = np.linalg.norm(gravity)
    return gravity / length if length > 0.0 else np.array([0.0, -1.0, 0.0])
