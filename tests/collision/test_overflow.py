"""A list that is full grows and the step is taken again: no buffer's size shows in the result."""

import numpy as np
import pytest
import warp as wp
from physics.scenes import Witness, cloth, floor, scene, solid

import pdipc
from pdipc.barrier import pairs
from pdipc.collision import moving_boxes as sweep
from pdipc.collision import patches
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.drive import Work

ROOMS = {
    "slots of a primitive": (sweep, "SLOTS", 1),
    "candidates": (sweep, "FIRST_PAIRS", 1),
    "overlapping patches": (patches, "FIRST_NEIGHBOURS", 0),
    "active pairs": (pairs, "FIRST_PAIRS", 1),
}


@pytest.fixture(autouse=True)
def no_room_for_each(monkeypatch):
    """Lists begin with FIRST_PAIRS, however many vertices there are."""
    for module in (sweep, pairs):
        monkeypatch.setattr(module, "PAIRS_OF_EACH", 0.0)


def crowded(broad_phase, method="barrier"):
    """A block falls on a folded sheet: lists are empty at first and grow over several steps."""
    sheet = cloth("sheet", [0.4, 0.4], [8, 8], at=(0, 0.01, 0), friction=0.3)
    block = solid("block", [0.1, 0.1, 0.1], [3, 3, 3], at=(0.02, 0.08, 0.01), velocity=[0, -2, 0])
    contact = {"activation_distance": 3e-3, "broad_phase": broad_phase, "method": method}
    return scene([block, sheet], [floor(2.0)], contact=contact)


def run(broad_phase, *, recorded=True, watched=False, method="barrier"):
    simulation = pdipc.Simulation(crowded(broad_phase, method), "cpu")
    simulation.work = Work(simulation.model, recorded=recorded)
    simulation.observe = Witness(simulation) if watched else None
    grown = []
    grow = simulation.work.grow
    simulation.work.grow = lambda: grown.append(grow()) or grown[-1]
    results = [simulation.step() for _ in range(6)]
    assert max(result.barriers for result in results) > 20
    counts = [(r.outer, r.local_global, r.linear_iterations, r.barriers, r.truncations) for r in results]
    return simulation.positions, counts, grown, simulation.observe


@pytest.fixture(scope="module")
def ample():
    with pytest.MonkeyPatch.context() as patch:
        for module, name, _ in ROOMS.values():
            patch.setattr(module, name, 30 if name in ("SLOTS", "FIRST_NEIGHBOURS") else 100_000)
        positions, counts, grown, _ = run("patches")
    assert not grown
    return positions, counts


@pytest.mark.parametrize("broad_phase", ["patches", "bvh"])
@pytest.mark.parametrize("rooms", [*([name] for name in ROOMS), list(ROOMS)], ids=[*ROOMS, "all"])
def test_same_bits_from_the_smallest_buffers(rooms, broad_phase, ample, monkeypatch):
    for name in rooms:
        monkeypatch.setattr(*ROOMS[name])
    for recorded in (True, False) if len(rooms) > 1 else (True,):
        positions, counts, grown, _ = run(broad_phase, recorded=recorded)
        assert np.array_equal(positions, ample[0])
        assert counts == ample[1]
        # slots are searched again instead, and trees over primitives have no overlapping patches
        if rooms != ["slots of a primitive"] and not (rooms == ["overlapping patches"] and broad_phase == "bvh"):
            assert grown
            assert all(grown)


def test_the_papers_mode_grows_too(monkeypatch):
    """Its pairs hold more of each pair, which has to grow with the rest."""
    expected = run("patches", method="paper")
    for name in ROOMS.values():
        monkeypatch.setattr(*name)
    positions, counts, grown, _ = run("patches", method="paper")
    assert len(grown) > len(expected[2])
    assert np.array_equal(positions, expected[0])
    assert counts == expected[1]


def test_a_step_taken_again_is_seen_once(ample, monkeypatch):
    """Watchers see the motions of the step that counts, none of those that were given up."""
    for module, name, value in ROOMS.values():
        monkeypatch.setattr(module, name, value)
    positions, counts, grown, witness = run("patches", watched=True)
    assert grown
    assert np.array_equal(positions, ample[0])
    assert witness.checked == sum(count[0] for count in counts)


def test_too_many_pairs_for_an_index(monkeypatch):
    """Where a list would be longer than its index can count, it is refused instead of cut."""
    monkeypatch.setattr(sweep, "FIRST_PAIRS", 50)
    monkeypatch.setattr(sweep, "LARGEST_LIST", 100)
    simulation = pdipc.Simulation(crowded("bvh"), "cpu")
    with pytest.raises(MemoryError, match="candidate pairs: the motion of a step or the activation distance is too large"):
        for _ in range(6):
            simulation.step()


def test_a_wrapped_count_is_an_overflow():
    """Counts that add up to more than 2^31 are flagged, though their sum as an int32 looks small."""
    device, overflow = Device("cpu"), wp.zeros(1, dtype=wp.int32, device="cpu")
    kernels = sweep.kernels(real("float64"))
    found = sweep.PairList(device, kernels, 3, overflow)
    found.found.assign(np.array([2**31 - 1, 2**31 - 1, 5], dtype=np.int32))
    with pytest.raises(MemoryError, match="4294967299 candidate pairs"):
        found.grow()


def test_what_was_too_much_once_is_remembered(monkeypatch):
    """A search within a step may end where fewer pairs are active than where the list was full."""
    monkeypatch.setattr(pairs, "FIRST_PAIRS", 1)
    block = solid("block", [0.1, 0.1, 0.1], [3, 3, 3], at=(0, 0.051, 0))
    work = Work(pdipc.build(scene([block], [floor(2.0)], contact={"activation_distance": 3e-3}), "cpu"))
    far = wp.clone(work.x)
    far.assign(work.x.numpy() + [0.0, 1.0, 0.0] * work.model.free_vertices[:, None])
    work.candidates.cover(work.x, work.x)
    work.candidates.grow()
    work.candidates.cover(work.x, work.x)
    work.pairs.freeze(work.candidates, work.x)
    work.pairs.freeze(work.candidates, far)
    assert work.pairs.count.numpy()[0] == 0
    assert work.pairs.grow() and work.pairs.capacity >= 16  # the vertices of its bottom
