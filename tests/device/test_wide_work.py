"""What CUDA runs, on the CPU with threads emulated: no result depends on their order, no thread has work that grows with the mesh, and
launches are few."""

import ast
import functools
import inspect
import textwrap
from collections import Counter

import numpy as np
import pytest
import warp as wp
from physics.scenes import floor, scene, solid

import pdipc
from device.emulated import Emulated
from pdipc import algorithm
from pdipc.drive import step
from pdipc.nonlinear.newton import Newton
from pdipc.work import Work

# Kernels of one thread over what does not grow with meshes: simulated bodies, of which 512 are told apart, and what is scripted.
OVER_BODIES = {"decide", "judge", "label", "spread_least", "start"}
OVER_MOVERS = {"advance"}
LAUNCHES = 30  # of an outer iteration in which nothing happens, beside its linear system
STRIDES = ("block_dim", "step", "stride", "shares", "size")  # loops with such a step are shared by many threads


def stack(cells=(1, 1, 1), **more):
    """Two blocks that slide and press on each other and on the floor; the low one may be rigid."""
    young = 1e5
    low = solid("low", (0.1, 0.1, 0.1), cells, at=(0, 0.0505, 0), young=young, friction=0.3)
    if more.pop("rigid", False):
        low = {**low, "kind": "rigid", "material": {}}
    high = solid("high", (0.1, 0.1, 0.1), cells, at=(0.01, 0.1512, 0), rotation=(0, 20, 0), young=young, friction=0.3)
    contact = {"activation_distance": 1e-3, **more.pop("contact", {})}
    return scene([low, high], [floor(0.5, friction=0.3)], contact=contact, tolerance=1e-3, **more)


def after_a_step(described, place):
    model = pdipc.build(described, place)
    work, state = Work(model, recorded=False), model.initial_state()
    velocities = np.tile([0.1, -0.05, 0.0], (model.vertex_count, 1)) * model.free_vertices[:, None]
    state.velocities.assign(velocities.astype(model.real.numpy))
    return step(model, state, work), work


WAYS = {
    "newton": {},
    "rigid": {"rigid": True},
    "restitution": {"contact": {"restitution": 0.5}},
    "global": {"contact": {"truncation": "global", "broad_phase": "bvh"}},
    "local-global": {"nonlinear_solver": "local-global", "linear_solver": "pcg"},
}


@functools.cache
def in_order(way):
    result, _ = after_a_step(stack(**WAYS[way]), Emulated())
    assert result.barriers > 0
    return result.state.arrays()


@pytest.mark.parametrize(
    ("way", "order"),
    [
        ("newton", "reversed"),
        ("newton", "shuffled"),
        ("rigid", "shuffled"),
        ("restitution", "shuffled"),
        ("global", "reversed"),
        ("local-global", "shuffled"),
    ],
)
def test_a_step_does_not_depend_on_the_order_of_threads(way, order):
    """Every thread, or block of threads, of every launch by itself: the same bits as in order."""
    found = after_a_step(stack(**WAYS[way]), Emulated(order))[0].state.arrays()
    for name, expected in in_order(way).items():
        assert np.array_equal(found[name], expected), name


def name_of(kernel: wp.Kernel) -> str:
    return kernel.func.__name__


def loops(kernel: wp.Kernel) -> tuple[bool, bool]:
    """Whether a kernel has a loop whose length is not known when it is compiled, and whether one of its loops is shared by threads."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kernel.func)))
    open_, shared = False, False
    for node in ast.walk(tree):
        if isinstance(node, ast.For) and isinstance(node.iter, ast.Call):
            parts = [ast.unparse(part) for part in node.iter.args]
            shared |= len(parts) == 3 and any(stride in parts[2] for stride in STRIDES)
            known = [part.isdigit() or part.split(".")[-1].isupper() or part.startswith("wp.static") for part in parts]
            open_ |= not (all(known) or parts == ["clock.shape[0]"])
    return open_, shared


def test_no_thread_has_work_that_grows_with_the_mesh():
    """Between two meshes, whatever launch has no more threads for the larger has no loop of its own, or shares it by threads."""
    threads = []
    for cells in ((1, 1, 1), (3, 3, 3)):
        place = Emulated()
        after_a_step(stack(cells), place)
        most: dict[wp.Kernel, int] = {}
        for kernel, count, _ in place.launches:
            most[kernel] = max(count, most.get(kernel, 0))
        threads.append(most)
    small, large = threads
    serial = {name_of(k) for k, count in large.items() if count <= small.get(k, count) and loops(k) == (True, False)}
    assert serial <= OVER_BODIES | OVER_MOVERS, serial


def test_an_iteration_of_conjugate_gradients_is_three_launches():
    place = Emulated()
    _, work = after_a_step(stack(), place)
    names = Counter(name_of(kernel) for kernel, *_ in place.launches if "wide_pcg" in kernel.module.name)
    assert names["multiply"] == names["advance"] > 0
    assert (
        names["begin"] <= names["correct"] - names["advance"] <= 2 * names["begin"]
    )  # at the start of a solve; again in free flight
    assert names["advance"] >= int(work.method.iterations.numpy()[0])


class Counting(Emulated):
    """Leaves out the launches of what is `not_counted`."""

    def not_counted(self, function):
        def run(*arguments):
            before = len(self.launches)
            function(*arguments)
            del self.launches[before:]

        return run


def test_launches_of_an_outer_iteration():
    """Without making and solving its linear system, in free fall: nothing is listed anew, truncated or searched."""
    place = Counting()
    falling = scene(
        [solid("one", (0.1, 0.1, 0.1), (1, 1, 1), at=(0, 0.2, 0))], [floor(0.5)], contact={"activation_distance": 1e-3}
    )
    model = pdipc.build(falling, place)
    work, state = Work(model, recorded=False), model.initial_state()
    work.set_scripted(state)
    wp.copy(work.x_start, state.positions)
    algorithm.begin(work)
    assert isinstance(work.method, Newton)
    work.method._assemble = place.not_counted(work.method._assemble)
    work.method._solve_linear = place.not_counted(work.method._solve_linear)
    for _ in range(2):
        place.launches.clear()
        algorithm.outer_iteration(work)
    assert work.candidates.needed.numpy()[0] == 0
    names = [f"{kernel.module.name} {name_of(kernel)}" for kernel, *_ in place.launches]
    assert len(names) <= LAUNCHES, names
