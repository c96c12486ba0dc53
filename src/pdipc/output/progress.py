"""How far a run is: a bar for terminals and notebooks."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from pdipc.output.summary import metres

if TYPE_CHECKING:
    from pdipc.simulation import StepInfo


@contextmanager
def bar_of_steps(total: int, console: Any = None) -> Iterator[Callable[["StepInfo"], None]]:
    """A bar of steps, which tells when kernels are compiled; yields a function to call after each.

    console: of rich, where it is drawn; None: standard output, or the notebook.
    """
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = [TextColumn("step"), BarColumn(bar_width=24), MofNCompleteColumn(), TextColumn("{task.fields[told]}")]
    last = time.monotonic()
    with Progress(*columns, TimeRemainingColumn(), console=console) as bar:
        task = bar.add_task("step", total=total, told="preparing")

        def advance(info: "StepInfo") -> None:
            nonlocal last
            now, result = time.monotonic(), info.result
            told = f"outer {result.outer:<3d} contacts {result.barriers:<6d} gap {metres(result.smallest_gap)}"
            bar.update(task, completed=info.step, total=info.steps, told=f"{told}  {1000 * (now - last):.0f} ms/step")
            last = now

        def compiled(modules: int) -> None:
            if modules == 1:
                bar.console.print("compiling kernels, once; they are kept for later runs")
            bar.update(task, told=f"{modules} modules of kernels compiled")

        with _told_of_compiling(compiled):
            yield advance


@contextmanager
def _told_of_compiling(tell: Callable[[int], None]) -> Iterator[None]:
    """Calls `tell` with the number of kernel modules that Warp has compiled, after each."""
    import warp as wp

    from pdipc.device import precision  # noqa: F401  (makes Warp quiet: what is set here comes after)

    usual, modules = wp.get_logger(), 0

    class Listening:
        debug, warning, error = staticmethod(usual.debug), staticmethod(usual.warning), staticmethod(usual.error)

        @staticmethod
        def info(message: str) -> None:
            nonlocal modules
            if message.endswith("(compiled)"):
                modules += 1
                tell(modules)

    level = wp.config.log_level
    wp.set_logger(Listening())
    wp.config.log_level = wp.LOG_INFO
    try:
        yield
    finally:
        wp.set_logger(usual)
        wp.config.log_level = level
