"""How many threads there are, that they are shared and not lost, and that callers in other threads and processes do no harm."""

import os
import subprocess
import sys
import threading
import time

import numpy as np
import pytest

import pdipc
from pdipc.device import threads
from pdipc.device.launch import Device, ForkedError
from tests.physics.scenes import floor, scene, solid

needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")


def small():
    block = solid("block", (0.2, 0.2, 0.2), (2, 2, 2), at=(0, 0.103, 0), velocity=(0, -1, 0))
    return scene([block], [floor()])


QUOTAS = {
    "version 2": ("0::/job\n", {"job/cpu.max": "250000 100000\n"}, 2.5),
    "version 2, limited above": ("0::/a/b\n", {"a/b/cpu.max": "max 100000\n", "a/cpu.max": "150000 100000\n"}, 1.5),
    "version 2, a container's own root": ("0::/\n", {"cpu.max": "300000 100000\n"}, 3.0),
    "version 2, the host's path": ("0::/docker/0123\n", {"cpu.max": "400000 100000\n"}, 4.0),
    "version 1": (
        "3:memory:/m\n2:cpu,cpuacct:/job\n0::/\n",
        {"cpu,cpuacct/job/cpu.cfs_quota_us": "50000\n", "cpu,cpuacct/job/cpu.cfs_period_us": "100000\n"},
        0.5,
    ),
    "version 1, under its short name": (
        "2:cpuacct,cpu:/job\n",
        {"cpu/job/cpu.cfs_quota_us": "200000\n", "cpu/job/cpu.cfs_period_us": "100000\n"},
        2.0,
    ),
    "version 1, not limited": (
        "2:cpu:/\n",
        {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"},
        threads.UNLIMITED,
    ),
    "no limit": ("0::/job\n", {"job/cpu.max": "max 100000\n"}, threads.UNLIMITED),
    "damaged": ("0::/job\n", {"job/cpu.max": "\n"}, threads.UNLIMITED),
}


@pytest.fixture
def groups(request, tmp_path, monkeypatch):
    """A tree of control groups in place of the system's; the CPUs that it grants."""
    of_process, files, granted = QUOTAS[request.param]
    (tmp_path / "cgroup").write_text(of_process)
    for name, text in files.items():
        path = tmp_path / "mounted" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.setattr(threads, "GROUPS_OF_PROCESS", tmp_path / "cgroup")
    monkeypatch.setattr(threads, "CGROUPS", tmp_path / "mounted")
    return granted


@pytest.mark.parametrize("groups", QUOTAS, indirect=True)
def test_quotas_of_containers(groups, monkeypatch):
    monkeypatch.delenv("PDIPC_THREADS", raising=False)
    monkeypatch.setattr(threads, "cores", lambda: 3)
    assert threads._quota(threads.GROUPS_OF_PROCESS, threads.CGROUPS) == groups
    assert threads.thread_count() == max(1, min(3, int(groups)))


def test_systems_without_affinity_or_groups(tmp_path, monkeypatch):
    monkeypatch.delenv("PDIPC_THREADS", raising=False)
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    monkeypatch.delattr(os, "process_cpu_count", raising=False)
    monkeypatch.setattr(threads, "GROUPS_OF_PROCESS", tmp_path / "nothing")
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert threads.thread_count() == 5
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert threads.thread_count() == 1


@pytest.mark.parametrize(("given", "count"), [("3", 3), (" 2 ", 2), ("64", 64)])
def test_the_environment_decides(given, count, monkeypatch):
    monkeypatch.setenv("PDIPC_THREADS", given)
    assert threads.thread_count() == Device("cpu").threads == count


@pytest.mark.parametrize("given", ["0", "-1", "two", "1.5", "99999", "²"])
def test_nonsense_in_the_environment_is_refused(given, monkeypatch):
    monkeypatch.setenv("PDIPC_THREADS", given)
    with pytest.raises(ValueError, match="PDIPC_THREADS"):
        Device("cpu")


def test_no_thread_is_left_behind(monkeypatch):
    """200 builds and batches of queries, and some steps."""
    monkeypatch.setenv("PDIPC_THREADS", "3")
    points = np.random.default_rng(0).normal(size=(3000, 8, 3))

    def use(step: bool) -> None:
        model = pdipc.build(small(), "cpu")
        if step:
            pdipc.Simulation(model).step()
        pdipc.time_of_impact(points, "edge_edge", device="cpu")

    use(step=True)
    before = threading.active_count()
    for i in range(200):
        use(step=i % 10 == 0)
    assert threading.active_count() == before
    assert sum(thread.name.startswith("pdipc") for thread in threading.enumerate()) == 2


@needs_fork
@pytest.mark.parametrize("busy", [False, True], ids=["quiet", "while another thread steps"])
def test_a_simulation_goes_on_after_a_fork(busy, tmp_path, monkeypatch):
    """In both processes, to the same bits."""
    monkeypatch.setenv("PDIPC_THREADS", "2")
    simulation = pdipc.Simulation(small(), "cpu")
    for _ in range(3):
        simulation.step()
    other, done = pdipc.Simulation(small(), "cpu"), threading.Event()

    def keep_stepping() -> None:
        while not done.is_set():
            other.step()

    stepping = threading.Thread(target=keep_stepping)
    if busy:
        stepping.start()
        time.sleep(0.05)
    child = os.fork()
    if child == 0:
        try:
            for _ in range(5):
                simulation.step()
            np.save(tmp_path / "child.npy", simulation.positions)
            other.step()
        finally:
            os._exit(0)
    try:
        for _ in range(5):
            simulation.step()
        until = time.monotonic() + 60.0
        while os.waitpid(child, os.WNOHANG) == (0, 0):
            assert time.monotonic() < until, "the child hangs"
            time.sleep(0.01)
    finally:
        done.set()
        if busy:
            stepping.join()
    np.testing.assert_array_equal(np.load(tmp_path / "child.npy"), simulation.positions)


def test_cuda_after_a_fork_is_refused(monkeypatch):
    device = Device("cpu")
    monkeypatch.setattr(threads, "process", threads.process + 1)
    device.refuse_forked()
    device.is_cuda = True
    with pytest.raises(ForkedError, match="does not survive a fork"):
        device.refuse_forked()


def test_queries_in_another_thread_are_no_part_of_a_recording(monkeypatch):
    """Another thread asks while steps are recorded: it gets its answer, and steps have the bits of steps alone."""
    monkeypatch.setenv("PDIPC_THREADS", "2")
    points = np.random.default_rng(1).normal(size=(3000, 8, 3))
    expected_times = pdipc.time_of_impact(points, "vertex_triangle", device="cpu")

    def positions() -> np.ndarray:
        simulation = pdipc.Simulation(small(), "cpu")
        for _ in range(4):
            simulation.step()
        return simulation.positions

    expected, done, wrong = positions(), threading.Event(), []

    def ask() -> None:
        while not done.is_set():
            try:
                np.testing.assert_array_equal(pdipc.time_of_impact(points, "vertex_triangle", device="cpu"), expected_times)
            except BaseException as error:
                wrong.append(error)
                return

    asking = threading.Thread(target=ask)
    asking.start()
    try:
        for _ in range(10):
            np.testing.assert_array_equal(positions(), expected)
    finally:
        done.set()
        asking.join()
    assert not wrong


def test_importing_and_counting_needs_no_linux():
    """As on a system that has neither fork nor affinity."""
    code = (
        "import os; "
        "[delattr(os, name) for name in ('fork', 'register_at_fork', 'sched_getaffinity') if hasattr(os, name)]; "
        "from pdipc.device.launch import Device; assert Device('cpu').threads >= 1"
    )
    counting = {name: value for name, value in os.environ.items() if name != "PDIPC_THREADS"}
    subprocess.run([sys.executable, "-c", code], check=True, env=counting)


def test_small_models_have_one_thread(monkeypatch):
    """Unless the environment says how many."""
    small, large = (
        {"bodies": [{"name": "sheet", "kind": "cloth", "mesh": {"shape": "grid", "size": [1, 1], "cells": [n, n]}}]}
        for n in (4, 24)
    )
    monkeypatch.delenv("PDIPC_THREADS", raising=False)
    monkeypatch.setattr(threads, "thread_count", lambda: 3)
    assert [pdipc.build(pdipc.Scene(**each), "cpu").device.threads for each in (small, large)] == [1, 3]
    monkeypatch.setenv("PDIPC_THREADS", "3")
    assert pdipc.build(pdipc.Scene(**small), "cpu").device.threads == 3
