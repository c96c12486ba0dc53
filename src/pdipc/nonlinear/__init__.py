"""Nonlinear solves inside Algorithm 1."""

from typing import Protocol

import warp as wp

from pdipc.barrier.pairs import Exerted, FrozenPairs
from pdipc.barrier.restitution import Restitution


class Method(Protocol):
    """How lines 5 to 12 and 16 of Algorithm 1 are done; chosen once, when `Work` is made. Every method only launches.

    pairs: the barriers that were listed last. iterations: (1,) int32, linear iterations since the step began; inner: (1,) int32,
    local-global iterations. numbers: see `status`. generation: grows whenever arrays were replaced, so that graphs are recorded anew.
    """

    iterations: wp.array
    inner: wp.array
    numbers: wp.array

    @property
    def pairs(self) -> FrozenPairs: ...

    @property
    def generation(self) -> int: ...

    def start(self) -> None:
        """Before the first outer iteration."""
        ...

    def freeze(self) -> None:
        """Line 5: the barriers at x."""
        ...

    def solve(self) -> None:
        """Lines 6 to 12: `u_tilde` and `x_tilde`, where the vertices want to go."""
        ...

    def accept(self) -> None:
        """Line 16: commits the truncated motion to `u` and `x`, and decides whether to go on: `going` and the status in `count`."""
        ...

    def correct(self, r: Restitution) -> None:
        """With restitution, where `r.needed`: solves for the motion `r.u_now` whose velocities bodies part with."""
        ...

    def exerted(self) -> tuple[Exerted, Exerted]:
        """The forces of contact in the step that was taken last, along the normals and across them. Not launched from a recording."""
        ...

    def grow(self) -> bool:
        """Makes room where a list was full; returns whether one was. Not launched."""
        ...
