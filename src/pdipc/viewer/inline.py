"""Scenes and runs in a notebook: a picture, a summary, and the viewer in a frame.

`Scene` and `Run` look here when a notebook asks them, by name: their rooms lie below this one.
"""

import base64
import html
import io
from pathlib import Path
from typing import Any

import numpy as np

from pdipc.output.results import Run
from pdipc.output.summary import metres, told_of
from pdipc.scene.assembly import assemble

SIZE = (560, 350)  # pixels
NEEDS = {"pyvista": "pictures", "viser": "viewer"}  # extras
TABLE = "margin:0;font-size:90%;border-collapse:collapse"


class Start(Run):
    """The start of a scene as a run of one frame, which is nowhere written."""

    def __init__(self, scene: Any):
        self.assembly = assemble(scene)
        self.folder, self.meta = Path("the scene"), {}
        self.scene = scene.model_dump(include={"contact": True, "picture": True, **LOOKS})
        self.records = [{"step": 0, "time": 0.0}]
        self.topology = {
            "triangles": self.assembly.triangles,
            **{name: np.asarray(values) for name, values in self.assembly.topology().items()},
        }

    def positions(self, frame: int) -> np.ndarray:
        """(n, 3) m. Raises IndexError for another frame than the first."""
        if frame not in (0, -1):
            raise IndexError(f"a start has one frame, not frame {frame}")
        return np.asarray(self.assembly.positions, dtype=np.float64)


LOOKS: Any = {part: {"__all__": {"name", "look"}} for part in ("bodies", "obstacles")}


def html_of_scene(scene: Any) -> str:
    """The start of a scene: a picture, and a table of its bodies."""
    start = Start(scene)
    rows: list[tuple[str, ...]] = [("body", "kind", "vertices", "triangles", "tets")]
    for body in start.assembly.bodies:
        sizes = (body.last - body.first, len(body.triangles), len(body.tets))
        rows.append((body.name, body.kind, *map(str, sizes)))
    simulation = scene.simulation
    lines = [
        f"{simulation.steps} steps of {simulation.time_step:g} s",
        f"size {metres(start.assembly.scene_size)}, activation distance {metres(start.assembly.activation_distance)}",
    ]
    return _page(scene.title or "Scene", start, rows, lines)


def html_of_run(run: Run) -> str:
    """The last frame of a run, and what `pdipc info` says of it."""
    lines = list(told_of(run, run.scene.get("simulation", {}).get("steps", 0)))
    return _page(run.scene.get("title") or str(run.folder), run, [], lines)


def _page(title: str, run: Run, rows: list[tuple[str, ...]], lines: list[str]) -> str:
    tell = html.escape
    cells = ("".join(f'<td style="padding:1px 8px;text-align:left">{tell(cell)}</td>' for cell in row) for row in rows)
    table = f'<table style="{TABLE}">{"".join(f"<tr>{row}</tr>" for row in cells)}</table>' if rows else ""
    said = "".join(f"<div>{tell(line)}</div>" for line in lines)
    return (
        f'<div style="display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start"><div>{_picture(run)}</div>'
        f"<div><b>{tell(title)}</b>{table}{said}</div></div>"
    )


def _picture(run: Run) -> str:
    """The last frame as an image, or why there is none."""
    if run.frame_count == 0:
        return "no frames yet"
    try:
        from PIL import Image

        from pdipc.pictures.render import drawing, settings_of

        last = run.frame_count - 1
        settings = settings_of(run).model_copy(update={"size": SIZE, **({"color": "body"} if isinstance(run, Start) else {})})
        with drawing(run, [last], settings) as drawn:
            picture = drawn.image(last)
    except ImportError as error:
        return f'pictures need: pip install "pdipc[{NEEDS.get(error.name or "", "pictures")}]"'
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    source = base64.b64encode(file.getvalue()).decode()
    return f'<img src="data:image/png;base64,{source}" width="{SIZE[0]}" height="{SIZE[1]}"/>'


class Shown:
    """The viewer in a thread, in a frame of the notebook. url: its address; `close` ends it."""

    def __init__(self, viewer: Any, height: int):
        import threading

        self.viewer, self.url, self.height = viewer, viewer.view.url, height
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._loop, name="pdipc viewer", daemon=True)
        self._thread.start()

    def _loop(self) -> None:
        try:
            self.viewer.loop(self._over.is_set)
        finally:
            self.viewer.close()

    def _repr_html_(self) -> str:
        return f'<iframe src="{self.url}" width="100%" height="{self.height}" frameborder="0"></iframe>'

    def close(self) -> None:
        """Ends the viewer."""
        self._over.set()
        self._thread.join()


def show_run(run: Run, height: int = 500) -> Shown:
    """Plays a run in a frame."""
    from pdipc.viewer import Playback

    return Shown(Playback(run), height)


def show_scene(scene: Any, device: str | None = None, height: int = 500) -> Shown:
    """Simulates a scene live in a frame."""
    from pdipc.viewer import Live

    return Shown(Live(scene, device=device), height)
