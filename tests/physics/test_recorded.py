"""A step as one recorded graph gives the bits of the same step launched kernel by kernel, however it is watched."""

import itertools
import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import warp as wp

import pdipc
import pdipc.device.launch
from pdipc.drive import Work, step
from pdipc.linear.solvers import SOLVERS
from physics.scenes import cloth, floor, scene, solid


def falling_cloth(precision):
    sheet = cloth("sheet", [0.4, 0.4], [8, 8], at=(0, 0.18, 0), rotation=(0, 9, 0), friction=0.3)
    block = solid("block", [0.1, 0.1, 0.1], [3, 3, 3], at=(0.02, 0.08, 0.01), velocity=[0, -1, 0])
    return scene([block, sheet], [floor(2.0)], precision=precision, contact={"activation_distance": 2e-3})


def run(precision, *, recorded=True, observe=None, threads=None, monkeypatch=None):
    if threads is not None:
        monkeypatch.setenv("PDIPC_THREADS", str(threads))
    simulation = pdipc.Simulation(falling_cloth(precision), "cpu", observe=observe)
    simulation.work = Work(simulation.model, recorded=recorded)
    results = [simulation.step() for _ in range(8)]
    counts = [(r.outer, r.local_global, r.linear_iterations, r.barriers, r.truncations, r.smallest_gap) for r in results]
    return simulation.positions, counts


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_recorded_equals_launched_one_by_one(precision, monkeypatch):
    expected, counts = run(precision, recorded=False)
    assert max(count[0] for count in counts) > 1
    assert max(count[4] for count in counts) > 0
    for threads in (1, 2, 3):
        positions, found = run(precision, threads=threads, monkeypatch=monkeypatch)
        assert np.array_equal(positions, expected)
        assert found == counts


def test_watching_changes_nothing():
    motions = []
    expected, counts = run("float64")
    positions, found = run("float64", observe=lambda x, x_end: motions.append((x.numpy(), x_end.numpy())))
    assert np.array_equal(positions, expected)
    assert found == counts
    assert len(motions) == sum(count[0] for count in counts)
    for (_, end), (start, _) in itertools.pairwise(motions):
        assert np.array_equal(end, start)


def test_a_step_allocates_nothing_and_is_read_once(monkeypatch):
    """Once the lists are long enough: no memory on the device, and one small array that the host waits for."""
    simulation = pdipc.Simulation(falling_cloth("float64"), "cpu")
    for _ in range(8):
        simulation.step()
    device, read, allocated = wp.get_device("cpu"), [], []
    allocate, numpy = device.default_allocator.allocate, wp.array.numpy
    monkeypatch.setattr(device.default_allocator, "allocate", lambda size: allocated.append(size) or allocate(size))
    monkeypatch.setattr(wp.array, "numpy", lambda self: read.append(self.size) or numpy(self))
    generation = simulation.work.candidates.generation, simulation.work.pairs.generation
    state, before = simulation.state, simulation.state.time
    assert simulation.step().barriers > 0
    assert (simulation.work.candidates.generation, simulation.work.pairs.generation) == generation
    assert simulation.state is state and state.time > before
    assert (allocated, read) == ([], [simulation.work.report.size])
    simulation.work.pairs._allocate(2 * simulation.work.pairs.capacity)  # what the test counts with does count
    assert allocated


def test_a_step_leaves_the_state_that_it_starts_from():
    model = pdipc.build(falling_cloth("float64"), "cpu")
    state = model.initial_state()
    kept = state.arrays()
    result = step(model, state)
    assert result.state is not state
    assert all(np.array_equal(state.arrays()[name], kept[name]) for name in kept)
    again = step(model, state, into=state)
    assert again.state is state
    assert all(np.array_equal(state.arrays()[name], result.state.arrays()[name]) for name in kept)


def test_a_driver_without_loops_in_graphs(monkeypatch):
    """Each kernel is launched alone, with the same bits, and the user is told."""
    expected, counts = run("float64")
    monkeypatch.setattr(pdipc.device.launch.Device, "records_loops", False)
    with pytest.warns(UserWarning, match="cpu has no loops in graphs"):
        positions, found = run("float64")
    assert np.array_equal(positions, expected)
    assert found == counts


@pytest.mark.parametrize("solver", SOLVERS)
def test_no_solver_records_where_the_driver_has_no_loops(solver, monkeypatch):
    """The same motion of a sheet in free fall, with nothing recorded."""
    described = scene(
        [cloth("sheet", [0.4, 0.4], [3, 3], at=(0, 0.3, 0))],
        [floor(2.0)],
        contact={"method": "paper"} if solver == "a-jacobi" else {},
        precision="float64",
        linear_solver=solver,
        **{} if solver == "a-jacobi" else {"nonlinear_solver": "local-global"},
    )
    expected = pdipc.Simulation(described, "cpu")
    expected.step()
    monkeypatch.setattr(pdipc.device.launch.Device, "records_loops", False)
    monkeypatch.setattr(pdipc.device.launch.Device, "capture", lambda *_: pytest.fail("recorded"))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*has no loops in graphs")
        found = pdipc.Simulation(described, "cpu")
    found.step()
    assert np.array_equal(found.positions, expected.positions)


def test_recording_allocates_nothing(monkeypatch):
    """CUDA refuses memory inside the loops of a graph."""
    simulation = pdipc.Simulation(falling_cloth("float64"), "cpu")
    device, allocated, recorded = wp.get_device("cpu"), [], []
    allocate, capture = device.default_allocator.allocate, pdipc.device.launch.Device.capture

    def counted(self, launches, keep_alive=None):
        with monkeypatch.context() as patch:
            patch.setattr(device.default_allocator, "allocate", lambda size: allocated.append(size) or allocate(size))
            recorded.append(launches.__name__)
            return capture(self, launches, keep_alive)

    monkeypatch.setattr(pdipc.device.launch.Device, "capture", counted)
    simulation.step()
    assert recorded
    assert allocated == []


def test_simulations_in_several_threads_take_turns(monkeypatch):
    """Warp records whatever any thread launches: without turns, one simulation's step would become part of another's."""
    monkeypatch.setenv("PDIPC_THREADS", "2")

    def positions(_=None):
        block = solid("block", (0.2, 0.2, 0.2), (2, 2, 2), at=(0, 0.103, 0), velocity=(0, -1, 0))
        made = pdipc.Simulation(scene([block], [floor()]), "cpu")
        for _ in range(5):
            made.step()
        return made.positions

    expected = positions()
    with ThreadPoolExecutor(3) as threads:
        for found in threads.map(positions, range(3)):
            np.testing.assert_array_equal(found, expected)
