"""Watching in the browser (viser, an extra): a run is played back, or a scene is simulated live and its bodies are dragged.

A page shows what a `Stage` holds. Where a scene is simulated, an `Engine` takes the steps in a thread of its own and keeps the frames;
the page shows the newest, or the one that the time line is at, so that neither waits for the other. What the browser does is only noted
by callbacks; the engine and the page's loop act on it. An error in a step ends the program with its message, as it does anywhere else.
"""

from collections.abc import Sequence
from typing import Any

from pdipc.viewer.grip import Grip as Grip
from pdipc.viewer.live import Live as Live
from pdipc.viewer.playback import Playback as Playback
from pdipc.viewer.stage import HOST, PORT
from pdipc.viewer.stage import Stage as Stage


def play(run: Any, host: str = HOST, port: int = PORT, origins: Sequence[str] = ()) -> None:
    """Plays a run, from `pdipc.open_run`, in the browser until Ctrl-C."""
    _serve(Playback(run, host, port, origins))


def simulate(
    scene: Any,
    host: str = HOST,
    port: int = PORT,
    device: str | None = None,
    origins: Sequence[str] = (),
    record: Any = None,
    watched: Any = None,
) -> None:
    """Simulates a scene live in the browser until Ctrl-C; see `Live`."""
    _serve(Live(scene, host, port, device, origins, record=record, watched=watched))


def _serve(shown: Playback | Live) -> None:
    print(f"open {shown.view.url} in a browser; Ctrl-C ends", flush=True)
    try:
        shown.loop()
    except KeyboardInterrupt:
        pass
    finally:
        shown.close()
