"""A run that is played back."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from pdipc.pictures.render import settings_of
from pdipc.scene.looks import looks
from pdipc.viewer.stage import HOST, PORT, Plot, Stage, badge, told

IDLE = 0.02  # s between two looks at what the browser did


class Playback:
    """A run, from `pdipc.open_run`, played in real time, with a slider of its frames. Raises RunError for one without frames."""

    def __init__(self, run: Any, host: str = HOST, port: int = PORT, origins: Sequence[str] = ()):
        first = run.positions(0)
        self.run, self.times = run, np.asarray(run.times)
        of_vertex = np.asarray(run.topology["body_of_vertex"])
        names = run.body_names
        told_of = {"names": names, "looks": looks(run.scene, names), "picture": settings_of(run)}
        self.view = Stage(
            run.triangles, of_vertex, list(run.body_kinds), run.topology["body_radii"], first, host, port, origins, **told_of
        )
        gui = self.view.server.gui
        last = run.frame_count - 1
        self.state = gui.add_html(badge({}))
        self.report = gui.add_markdown("")
        with gui.add_folder("time line"):
            self.frame = gui.add_slider("frame", min=0, max=max(1, last), step=1, initial_value=0, disabled=last == 0)
            self.playing = gui.add_checkbox("play", initial_value=last > 0)
            buttons = gui.add_button_group("", ("back", "on"))
            self.speed = gui.add_slider("speed", min=0.1, max=4.0, step=0.1, initial_value=1.0, hint="1 is real time")
        with gui.add_folder("plots", expand_by_default=False):
            residuals = Plot(gui, "residual, log10 of m", ("residual",), log=True)
        solved = [record for record in run.records if record.get("residual")]
        residuals.show([record["time"] for record in solved], [(record["residual"],) for record in solved])
        self.color = self.view.add_view_panel()
        buttons.on_click(lambda _: self._move(-1 if buttons.value == "back" else 1))
        self.time = 0.0
        self.shown: tuple[int, str] = (-1, "")
        self._field: Any = None

    def _move(self, frames: int) -> None:
        self.playing.value = False
        self.frame.value = int(np.clip(self.frame.value + frames, 0, len(self.times) - 1))

    def advance(self, seconds: float) -> None:
        """Goes on by `seconds` of the viewer's time where it plays, from the start after the end; then shows what the slider says."""
        if self.frame.value != self.shown[0]:  # moved by hand
            self.time = float(self.times[min(self.frame.value, len(self.times) - 1)])
        if self.playing.value:
            self.time += seconds * self.speed.value
            if self.time > self.times[-1]:
                self.time = 0.0
            self.frame.value = int(np.searchsorted(self.times, self.time, side="right")) - 1
        if (self.frame.value, self.color.value) != self.shown:
            frame = min(self.frame.value, len(self.times) - 1)
            self.shown = (self.frame.value, self.color.value)
            record = {name: value for name, value in self.run.records[frame].items() if name not in ("step", "time")}
            pressure, top = self._pressure(frame) if self.color.value == "pressure" else (None, 1.0)
            self.view.show(self.run.positions(frame), pressure, top)
            self.state.content = badge(record, f"colors to {top:.3g} Pa" if pressure is not None else "")
            self.report.content = told(self.times[frame], record)

    def _pressure(self, frame: int) -> tuple[np.ndarray, float]:
        """(n,) Pa on bodies, and what the last colour stands for: of all frames, once."""
        from pdipc.pictures.render import pressure

        if self._field is None:
            self.state.content = badge({}, "finding the pressures of all frames")
            self._field = pressure(self.run, list(range(self.run.frame_count)))
        return np.where(self.run.obstacle, 0.0, self._field.values(frame)), self._field.top

    def loop(self, over: Callable[[], bool] = lambda: False) -> None:
        """Plays until `over()` or an exception such as KeyboardInterrupt."""
        last = time.monotonic()
        while not over():
            time.sleep(IDLE)
            now = time.monotonic()
            self.advance(now - last)
            last = now

    def close(self) -> None:
        """Ends the page."""
        self.view.close()
