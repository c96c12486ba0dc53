"""Algorithm 1 of the paper (docs/paper_map.md says where and why it departs), in launches only: a step is recorded once and replayed.

`w` is the step's `Work`: the buffers, the candidates of culling, the truncation, and the method, which is how lines 5 to 12 and 16 are
done: projected Newton, local-global, or as printed (see `nonlinear/__init__.py` for what a method is).

Positions within a step are x* + u: what counts is the displacement u, which rounding cannot lose where x* is large and the step short.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pdipc.work import Work


def time_step(w: Work) -> None:
    """All of Algorithm 1."""
    begin(w)
    w.device.loop(w.going, lambda: outer_iteration(w))  # line 4
    finish(w)


def begin(w: Work) -> None:
    """Lines 1 to 3: z, the predictor, and the pairs that are near where the step starts."""
    w.start_clock()
    w.predict()  # lines 1 and 2
    w.candidates.check(w.x, w.x)
    w.device.when(w.candidates.needed, lambda: w.candidates.cover(w.x, w.x))
    w.method.start()
    w.mark("ccd")


def outer_iteration(w: Work) -> None:
    """Lines 5 to 16."""
    w.method.freeze()  # line 5: barriers at x
    w.mark("barrier")
    w.method.solve()  # lines 6 to 12: x~
    w.mark("solver")
    w.candidates.check(w.x, w.x_tilde)
    w.device.when(w.candidates.needed, lambda: w.candidates.cover(w.x, w.x_tilde))  # line 13
    w.truncation.truncate(w.candidates, w.x_start, w.u, w.u_tilde, w.x)  # lines 14 and 15
    w.mark("ccd")
    w.method.accept()  # line 16: x, and whether to go on
    w.mark("misc")


def finish(w: Work) -> None:
    """Line 18, after what restitution makes of the velocities."""
    w.rebound()
    w.part()
    w.mark("misc")
    w.write_report()
