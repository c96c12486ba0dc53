"""A simulation in a thread of its own, with the frames since its start: what a page shows, plays back and records."""

import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.audit import audit
from pdipc.output.results import RunWriter
from pdipc.simulation import Simulation, stats_of, writer_of

KEPT = 1 << 29  # bytes of frames that are kept; then the oldest go
IDLE = 0.02  # s between two looks at what the page asked for


@dataclass
class Shot:
    """A frame. positions: (n, 3) of the simulation's precision, m; energies: kinetic, elastic, barrier, gravity, J, where asked for;
    pressure: (n,) Pa, where asked for. record: statistics of the step.
    """

    step: int
    time: float
    positions: np.ndarray
    record: dict[str, Any]
    energies: tuple[float, ...] | None = None
    pressure: np.ndarray | None = None


class Engine:
    """Takes steps as the page says; all but `ask`, `newest`, `frames` and `rate` belong to the thread that calls `advance`.

    scene, device: see `pdipc.Simulation`. running: whether it goes on by itself. speed: simulated seconds a second, at most; wants_energies,
    wants_pressure: whether frames have these. before_step: called before each step with the simulation.
    """

    def __init__(self, scene: Any, device: str | None = None, before_step: Callable[[Simulation], None] = lambda _: None):
        self.scene, self.device, self.before_step = scene, device, before_step
        self.running, self.speed = True, 1.0
        self.wants_energies, self.wants_pressure = True, False
        self.error: BaseException | None = None
        self.rate = 0.0  # steps a second, of the last few
        self._asked: deque[Callable[[], None]] = deque()
        self._lock = threading.Lock()
        self._ends: deque[float] = deque(maxlen=8)
        self._over = threading.Event()
        self._thread: threading.Thread | None = None
        self._writer: RunWriter | None = None
        self.build(scene)

    # --- from any thread ---

    def ask(self, action: Callable[[], None]) -> None:
        """Has `action` done between two steps."""
        self._asked.append(action)

    @property
    def newest(self) -> Shot:
        """The last frame."""
        with self._lock:
            return self._frames[-1]

    @property
    def frames(self) -> list[Shot]:
        """Those that are kept, in order."""
        with self._lock:
            return list(self._frames)

    def start(self) -> None:
        """Begins to run in a thread; an exception ends it and is kept in `error`."""
        self._thread = threading.Thread(target=self._loop, name="pdipc engine", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread after the step in progress, and the recording."""
        self._over.set()
        if self._thread is not None:
            self._thread.join()
        self.stop_recording()

    # --- from the thread that steps ---

    def build(self, scene: Any, keep_state: bool = False) -> None:
        """Simulates `scene` from its start; keep_state: from where the last one is instead, whose meshes must be the same."""
        simulation = Simulation(scene, self.device)
        if keep_state:
            simulation.state = simulation.model.state_from(self.simulation.state.arrays())
            self.simulation, self.scene = simulation, scene
            return
        self.stop_recording()
        self.simulation, self.scene = simulation, scene
        self._begin()

    def reset(self) -> None:
        """Back to the start; ends the recording."""
        self.stop_recording()
        self.simulation.reset()
        self._begin()

    def step(self) -> None:
        """One step."""
        self.before_step(self.simulation)
        result = self.simulation.step(forces=self.wants_pressure)
        positions = self.simulation.state.positions.numpy().copy()
        shot = Shot(self.simulation.steps_done, self.simulation.state.time, positions, stats_of(result))
        if result.forces is not None:
            shot.pressure = result.forces.pressures(positions.astype(np.float64), self.simulation.triangles)
        shot.energies = self._energies()
        self._ends.append(time.monotonic())
        if len(self._ends) > 1:
            self.rate = (len(self._ends) - 1) / max(self._ends[-1] - self._ends[0], 1e-9)
        with self._lock:
            self._frames.append(shot)
            while len(self._frames) > 2 and len(self._frames) * positions.nbytes > KEPT:
                self._frames.popleft()
        if self._writer is not None:
            self._write(shot)

    def advance(self) -> None:
        """Does what was asked for, and takes a step where it runs."""
        while self._asked:
            self._asked.popleft()()
        if self.running:
            self.step()

    def record(self, folder: str | Path) -> None:
        """Writes all frames since the start, and those to come, into a run folder. Raises RunError where the folder does not take it,
        ValueError where the first frames are not kept any more.
        """
        if self.frames[0].step != 0:
            raise ValueError("the first frames are not kept any more; reset, then record")
        self._writer = writer_of(self.simulation, folder, None, live="pulled by hand")
        for shot in self.frames:
            self._write(shot)

    def stop_recording(self) -> None:
        """Ends the run folder, with a checkpoint."""
        if self._writer is not None:
            self._writer.checkpoint(self.simulation.steps_done, self.simulation.state.arrays())
            self._writer.close()
            self._writer = None

    @property
    def recording(self) -> bool:
        """Whether frames are written."""
        return self._writer is not None

    # --- inside ---

    def _begin(self) -> None:
        shot = Shot(0, self.simulation.state.time, self.simulation.state.positions.numpy().copy(), {})
        shot.energies = self._energies()
        self._ends.clear()
        with self._lock:
            self._frames = deque([shot])

    def _energies(self) -> tuple[float, ...] | None:
        if not self.wants_energies:
            return None
        found = audit(self.simulation.model, self.simulation.state, self.simulation.work)
        return found.kinetic, found.elastic, found.barrier, found.gravity

    def _write(self, shot: Shot) -> None:
        assert self._writer is not None
        self._writer.append(shot.step, shot.time, shot.positions, shot.record)

    def _loop(self) -> None:
        try:
            while not self._over.is_set():
                began, running = time.monotonic(), self.running
                self.advance()
                h = self.scene.simulation.time_step
                pause = h / max(self.speed, 1e-6) if running else IDLE
                while not self._over.is_set() and not self._asked and (left := pause - (time.monotonic() - began)) > 0.0:
                    time.sleep(min(left, IDLE))
        except BaseException as error:
            self.error = error
