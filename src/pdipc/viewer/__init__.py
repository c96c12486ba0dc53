"""Watching in the browser (viser, an extra): a run is played back, or a scene is simulated live and its bodies are dragged.

What the browser does is only noted by callbacks; one loop, in the caller's thread, acts on it. So an error ends the program with
its message, as it does anywhere else, and no state is shared between threads but plain values.
"""

import contextlib
import io
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse
from scipy.sparse.linalg import cg

from pdipc import constraints
from pdipc.model import elasticity
from pdipc.output.skins import skin
from pdipc.simulation import Simulation, stats_of
from pdipc.viewer.guard import EVERYWHERE, Guard

PALETTE = ((228, 120, 60), (70, 120, 190), (110, 170, 90), (200, 90, 120), (150, 120, 190), (220, 180, 70))
GREY = (185, 185, 190)
HOST, PORT = "localhost", 8080
DIRECTION = np.array([0.7, 0.42, 1.0])  # from what is seen to the camera, as in rendered pictures
IDLE = 0.02  # s between two looks at what the browser did

# What is dragged is on a damped spring, in units of its own compliance, so that it follows alike in cloth and in heavy blocks. The
# spring is explicit in time: PULL and DRAG are far below what is stable for the compliance that is computed, because a body that
# turns or folds gives way more easily than the constant matrix says.
PULL, DRAG = 0.1, 0.3
REACH = 0.1  # of the scene size: further away, the pull grows no more
GRIP, HELD = 0.2, 8  # radius of what is held, of the body's size, and least number of vertices: one alone would be torn out


class View:
    """The surfaces of all bodies on a web page, one mesh a body.

    triangles: (m, 3); body_of_vertex: (n,); kinds: "solid", "cloth", "rod" or "obstacle" a body, radii: (bodies,) m, of rods;
    positions: (n, 3), m.
    The page is served at `url` as long as the object lives, to whoever knows that address, which has a token in it (`guard`); if the
    port is taken, the next free one is used. origins: pages elsewhere that may connect too.
    Raises OSError for a host that this machine cannot serve at, ValueError for an origin that is none.
    """

    def __init__(
        self,
        triangles: np.ndarray,
        body_of_vertex: np.ndarray,
        kinds: list[str],
        radii: np.ndarray,
        positions: np.ndarray,
        host: str,
        port: int,
        origins: Sequence[str] = (),
    ):
        import viser

        _must_be_here(host)
        guard = Guard(host, origins)
        with guard.on_duty(), contextlib.redirect_stdout(io.StringIO()):  # viser prints its address, without the token
            self.server = viser.ViserServer(host=host, port=port, verbose=False)
        shown = "localhost" if host in EVERYWHERE else f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self.server.get_port()}/{guard.token}/"
        self.server.scene.set_up_direction("+y")
        self._aim(positions[np.isin(body_of_vertex, [i for i, kind in enumerate(kinds) if kind != "obstacle"])])
        self.meshes, self.skins = [], []
        of_triangle = body_of_vertex[triangles[:, 0]]
        for body, kind in enumerate(kinds):
            drawn = skin(triangles[of_triangle == body], float(radii[body]))
            self.skins.append(drawn)
            self.meshes.append(
                self.server.scene.add_mesh_simple(
                    f"/body{body}",
                    drawn.points(positions).astype(np.float32),
                    drawn.triangles,
                    color=GREY if kind == "obstacle" else PALETTE[body % len(PALETTE)],
                    side="double",
                )
            )

    def _aim(self, points: np.ndarray) -> None:
        low, high = points.min(axis=0), points.max(axis=0)
        middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
        self.server.initial_camera.look_at = tuple(middle)
        self.server.initial_camera.position = tuple(middle + 1.5 * size * DIRECTION / np.linalg.norm(DIRECTION))

    def show(self, positions: np.ndarray) -> None:
        """Moves all bodies to positions (n, 3), m; only the vertices of bodies that moved are sent."""
        with self.server.atomic():
            for mesh, drawn in zip(self.meshes, self.skins, strict=True):
                mesh.vertices = drawn.points(positions).astype(np.float32)


def _must_be_here(host: str) -> None:
    """viser would wait for ever for a server that cannot start."""
    try:
        family, kind, _, _, address = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind(address)
    except OSError as error:
        raise OSError(f'host "{host}" is no address of this machine ({error.strerror}); it must be like localhost') from error


class Playback:
    """A run, from `pdipc.open_run`, played in real time, with a slider of its frames. Raises RunError for one without frames."""

    def __init__(self, run: Any, host: str = HOST, port: int = PORT, origins: Sequence[str] = ()):
        first = run.positions(0)
        self.run, self.times, self.stats = run, np.asarray(run.times), run.stats
        of_vertex = np.asarray(run.topology["body_of_vertex"])
        self.view = View(run.triangles, of_vertex, list(run.body_kinds), run.topology["body_radii"], first, host, port, origins)
        gui = self.view.server.gui
        last = run.frame_count - 1
        self.frame = gui.add_slider("frame", min=0, max=max(1, last), step=1, initial_value=0, disabled=last == 0)
        self.playing = gui.add_checkbox("play", initial_value=last > 0)
        self.speed = gui.add_slider("speed", min=0.1, max=4.0, step=0.1, initial_value=1.0, hint="1 is real time")
        self.report = gui.add_markdown("")
        self.time = 0.0
        self.shown = -1

    def advance(self, seconds: float) -> None:
        """Goes on by `seconds` of the viewer's time where it plays, from the start after the end; then shows what the slider says."""
        if self.frame.value != self.shown:  # moved by hand
            self.time = float(self.times[min(self.frame.value, len(self.times) - 1)])
        if self.playing.value:
            self.time += seconds * self.speed.value
            if self.time > self.times[-1]:
                self.time = 0.0
            self.frame.value = int(np.searchsorted(self.times, self.time, side="right")) - 1
        if self.frame.value != self.shown:
            self.shown = min(self.frame.value, len(self.times) - 1)
            self.view.show(self.run.positions(self.shown))
            record = self.stats[self.shown - 1] if self.shown else {}
            self.report.content = _told(self.times[self.shown], record)

    def loop(self) -> None:
        """Plays until an exception such as KeyboardInterrupt."""
        last = time.monotonic()
        while True:
            time.sleep(IDLE)
            now = time.monotonic()
            self.advance(now - last)
            last = now


@dataclass
class Grip:
    """What the mouse holds: a vertex, and the vertices (k,) around it with their shares (k,) of the force.

    compliance: how far their mean gives way within a step, per force, m/N: s . A^-1 s for the shares s of the free vertices.
    """

    vertex: int
    vertices: np.ndarray
    shares: np.ndarray
    compliance: float

    @staticmethod
    def at(simulation: Simulation, body: int, point: np.ndarray) -> "Grip | None":
        """The grip on `body` nearest to `point` (3,), m; None if no vertex of it is free."""
        model, x = simulation.model, simulation.positions
        own = model.assembly.bodies[body]
        free = np.flatnonzero(~model.assembly.scripted)
        choice = free[(free >= own.first) & (free < own.last)]
        if len(choice) == 0:
            return None
        away = np.linalg.norm(x[choice] - point, axis=1)
        vertex = choice[np.argmin(away)]
        away = np.linalg.norm(x[choice] - x[vertex], axis=1)
        radius = max(GRIP * np.linalg.norm(np.ptp(x[own.first : own.last], axis=0)), np.sort(away)[:HELD][-1])
        vertices = choice[away <= radius]
        mass, h = model.mass.numpy().astype(np.float64), model.settings.time_step
        shares = np.zeros(model.vertex_count)
        shares[vertices] = mass[vertices] / mass[vertices].sum()
        sets, _ = elasticity(model.assembly)  # the constant matrix of projective dynamics, whatever solves the step
        inertia = scipy.sparse.diags_array(mass * (1.0 / (h * h) + model.settings.damping / h))
        matrix = scipy.sparse.csr_array(constraints.stiffness_matrix(model.vertex_count, sets) + inertia)[free][:, free]
        preconditioner = scipy.sparse.diags_array(1.0 / matrix.diagonal())
        given_way, _ = cg(matrix, shares[free], rtol=1e-2, maxiter=200, M=preconditioner)  # a few per cent do no harm
        return Grip(int(vertex), vertices, shares[vertices], float(given_way @ shares[free]) * model.substeps**2)

    def forces(self, simulation: Simulation, point: np.ndarray) -> np.ndarray:
        """(k, 3) N that pull the vertex towards `point` (3,), m, within the next step."""
        model, state = simulation.model, simulation.state
        way = point - state.positions.numpy()[self.vertex]
        way = way * min(1.0, REACH * model.assembly.scene_size / max(np.linalg.norm(way), 1e-300))
        motion = model.scene.simulation.time_step * self.shares @ state.velocities.numpy()[self.vertices]
        return self.shares[:, None] * (PULL * way - DRAG * motion) / self.compliance


class Live:
    """A scene simulated live, no faster than real time: run, pause, one step, reset; dragging a body pulls what is under the
    mouse towards it.

    device: see `pdipc.build`. Raises SceneError for a scene that cannot be simulated.
    """

    def __init__(self, scene: Any, host: str = HOST, port: int = PORT, device: str | None = None, origins: Sequence[str] = ()):
        self.simulation = Simulation(scene, device)
        self.assembly = assembly = self.simulation.model.assembly
        kinds = [body.kind for body in assembly.bodies]
        triangles, positions = self.simulation.triangles, self.simulation.positions
        radii = assembly.topology()["body_radii"]
        self.view = View(triangles, assembly.body_of_vertex, kinds, radii, positions, host, port, origins)
        gui = self.view.server.gui
        self.running = gui.add_checkbox("run", initial_value=True)
        self.report = gui.add_markdown(_told(0.0, {}))
        one_step, reset = gui.add_button("one step"), gui.add_button("reset")
        gui.add_markdown("Drag a body to pull at it, the background to turn the view.")
        self.todo: deque[Callable[[], None]] = deque()  # what the browser asked for since the last look
        one_step.on_click(lambda _: self.todo.append(self.step))
        reset.on_click(lambda _: self.todo.append(self.reset))
        self.held: Grip | None = None
        self.point = np.zeros(3)  # where the mouse is, m
        for body, mesh in enumerate(self.view.meshes):
            if kinds[body] != "obstacle":
                mesh.on_drag("left")(lambda event, body=body: self.todo.append(self._dragging(body, event)))

    def _dragging(self, body: int, event: Any) -> Callable[[], None]:
        return lambda: self.drag(body, event.phase, event.start_position, event.end_position)

    def drag(self, body: int, phase: str, start: Any, end: Any) -> None:
        """Takes hold of the free vertex of `body` nearest to the point `start`, m, and of those around it, on phase "start"; leads
        them to `end`, m; and lets go on phase "end". A body without free vertices stays as it is.
        """
        self.point = np.array(end, dtype=np.float64)
        if phase == "start":
            self.held = Grip.at(self.simulation, body, np.asarray(start))
        elif phase == "end":
            self.held = None

    def step(self) -> None:
        """One step, with the pull of the mouse."""
        held = self.held
        if held is None:
            self.simulation.set_vertex_force(np.zeros(0), np.zeros((0, 3)))
        else:
            self.simulation.set_vertex_force(held.vertices, held.forces(self.simulation, self.point))
        self._show(stats_of(self.simulation.step()))

    def reset(self) -> None:
        """Back to the start, with nothing held."""
        self.held = None
        self.simulation.reset()
        self._show({})

    def advance(self) -> None:
        """Does what was asked for, and takes a step where it runs."""
        while self.todo:
            self.todo.popleft()()
        if self.running.value:
            self.step()

    def _show(self, record: dict[str, Any]) -> None:
        self.view.show(self.simulation.positions)
        self.report.content = _told(self.simulation.state.time, record)

    def loop(self) -> None:
        """Simulates until an exception such as KeyboardInterrupt."""
        h = self.simulation.model.scene.simulation.time_step
        while True:
            began = time.monotonic()
            try:
                self.advance()
            except Exception as error:
                self.report.content = f"**The simulation ended:** {error}"
                raise
            time.sleep(max(0.0, (h if self.running.value else IDLE) - (time.monotonic() - began)))


def _told(at: float, record: dict[str, Any]) -> str:
    """Time and statistics of a step, for people."""
    lines = [f"time {at:.3f} s"]
    if record:
        gap = record.get("smallest_gap")
        lines.append(f"contacts {record.get('barriers', 0)}, smallest gap {'none' if gap is None else f'{1e3 * gap:.3g} mm'}")
        lines.append(f"outer iterations {record.get('outer', 0)}, {sum(record.get('milliseconds', {}).values()):.0f} ms a step")
        lines.append(record.get("message", ""))
    return "\n\n".join(filter(None, lines))


def play(run: Any, host: str = HOST, port: int = PORT, origins: Sequence[str] = ()) -> None:
    """Plays a run, from `pdipc.open_run`, in the browser until Ctrl-C."""
    _serve(Playback(run, host, port, origins))


def simulate(scene: Any, host: str = HOST, port: int = PORT, device: str | None = None, origins: Sequence[str] = ()) -> None:
    """Simulates a scene live in the browser until Ctrl-C; see `Live`."""
    _serve(Live(scene, host, port, device, origins))


def _serve(shown: Playback | Live) -> None:
    print(f"open {shown.view.url} in a browser; Ctrl-C ends", flush=True)
    try:
        shown.loop()
    except KeyboardInterrupt:
        pass
    finally:
        shown.view.server.stop()
