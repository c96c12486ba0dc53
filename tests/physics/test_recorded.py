"""A step as one recorded graph gives the bits of the same step launched kernel by kernel, however it is watched."""

import itertools

import numpy as np
import pytest

import pdipc
from pdipc.step import Work
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
