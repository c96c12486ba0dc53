"""What is cut for a GPU, on the CPU with blocks of threads emulated: the rigid modes, and conjugate gradients in three launches."""

import numpy as np
import pytest
import scipy.linalg
import warp as wp
from device.emulated import Emulated

from linear.test_blocks import NO, YES, assembled, contact_matrix, crowded, elastic, on_free
from pdipc.linear import wide_modes
from pdipc.linear.rigid_modes import RigidModes
from pdipc.linear.wide_modes import WideModes


@pytest.fixture(scope="module")
def wide():
    """A crowded scene on a device that is cut as CUDA; work, positions, and contacts."""
    place = Emulated()
    model = crowded(device=place)
    return place, model, *assembled(model, YES)


@pytest.mark.parametrize("group", [None, 10, 4])
def test_the_modes_are_those_of_the_cpu(wide, group):
    """C^-1 from blocks of threads against dense algebra, Z^T r and the arms against what they should be."""
    place, model, work, now, contacts = wide
    n, free, matrix = model.vertex_count, model.free_vertices, work.method.matrix
    modes = WideModes(place, model.real, matrix, free, group)
    modes.prepare(now, contacts)
    r = np.random.default_rng(2).standard_normal((n, 3)) * free[:, None]
    modes.restrict(wp.array(r, dtype=wp.vec3d, device="cpu"))
    label, arms, size = modes.label.numpy()[:n], modes.arms.numpy(), 6 * modes.groups
    z = np.zeros((n, 3, modes.groups, 6))
    for i in np.flatnonzero(label >= 0):
        z[i, :, label[i], :3] = np.eye(3)
        z[i, :, label[i], 3:] = np.cross(np.eye(3), arms[i]).T
    z = z.reshape(3 * n, -1)
    c = z.T @ (elastic(model, matrix) + contact_matrix(contacts, n)) @ z
    solved = modes.solved.numpy().reshape(size, size)
    assert np.abs(c @ solved @ c - c).max() < 1e-9 * np.abs(c).max()  # a small group does not have all motions
    sums = np.zeros((modes.groups, 6))
    np.add.at(sums, modes.chunk_group.numpy()[: modes.chunks], modes.sums.numpy())
    assert np.allclose(sums.ravel(), z.T @ r.ravel(), rtol=0, atol=1e-12)
    for g in range(modes.groups):
        mine = arms[label == g]
        assert np.allclose(mine.sum(axis=0), 0.0, atol=1e-12)
        assert np.isclose((mine**2).sum(), len(mine)) or len(mine) == 1


def test_motions_that_a_group_does_not_have(wide):
    """Vertices on a line do not turn about it: the row and column of a lost pivot are zero, and the rest is the inverse of the rest."""
    place, model, *_ = wide
    rng, groups = np.random.default_rng(0), 3
    size, gone = 6 * groups, [5, 13]
    a = rng.standard_normal((size, size))
    c = a @ a.T + size * np.eye(size)
    c[gone], c[:, gone] = 0.0, 0.0
    c[gone, gone] = 1e-16
    k = wide_modes.kernels(model.real)
    here, there = (wp.array(each.ravel(), dtype=wp.float64, device="cpu") for each in (c, np.zeros_like(c)))
    lead = wp.array(np.where(np.isin(np.arange(size), gone), 1.0, np.diag(c)), dtype=wp.float64, device="cpu")
    for pivot in range(groups):
        place.launch(k.eliminate, 2 * size, [groups, 2, pivot, lead, here, there])
        here, there = there, here
    kept = np.setdiff1d(np.arange(size), gone)
    expected = np.zeros_like(c)
    expected[np.ix_(kept, kept)] = np.linalg.inv(c[np.ix_(kept, kept)])
    assert np.abs(here.numpy().reshape(size, size) - expected).max() < 1e-12


@pytest.mark.parametrize("project", [NO, YES], ids=["exact", "projected"])
@pytest.mark.parametrize("count", [0, 1, 2])
def test_the_solution_is_that_of_scipy(count, project):
    """With no contacts, barriers, and friction as well; in as many iterations as the CPU takes."""
    place = Emulated()
    model = crowded(device=place)
    work, now, contacts = assembled(model, project)
    contacts = contacts[:count]
    n, free, matrix, solver = model.vertex_count, model.free_vertices, work.method.matrix, work.method.solver
    rng = np.random.default_rng(1)
    k = elastic(model, matrix) + (contact_matrix(contacts, n) if contacts else 0.0)
    b, start = rng.standard_normal((n, 3)) * free[:, None], 1e-3 * rng.standard_normal((n, 3)) * ~free[:, None]
    p = wp.array(np.append(start, np.zeros((1, 3)), axis=0), dtype=wp.vec3d, device="cpu")
    right = wp.array(b, dtype=wp.vec3d, device="cpu")
    solver.prepare(now, contacts)
    place.launches.clear()
    solver.solve(p, right, contacts, 0.0, NO, 1e-10)
    taken = int(solver.iterations.numpy()[0])

    narrow = crowded()
    work, now, others = assembled(narrow, project)
    reference = work.method.solver
    q = wp.array(np.append(start, np.zeros((1, 3)), axis=0), dtype=wp.vec3d, device="cpu")
    reference.prepare(now, others[:count])
    reference.solve(q, right, others[:count], 0.0, NO, 1e-10)
    assert np.abs(p.numpy() - q.numpy()).max() < 1e-7 * np.abs(q.numpy()).max()
    assert solver.indefinite.numpy()[0] == reference.indefinite.numpy()[0]
    expected = int(reference.iterations.numpy()[0])
    assert abs(taken - expected) <= max(2, 0.02 * expected)
    if project is YES:
        inside = np.repeat(free, 3)
        whole = right.numpy().ravel()[inside] - k[np.ix_(inside, ~inside)] @ start.ravel()[~inside]
        expected = scipy.linalg.solve(on_free(k, free), whole, assume_a="pos")
        assert np.abs(p.numpy()[:n].ravel()[inside] - expected).max() < 1e-6 * np.abs(expected).max()


def test_groups_are_the_same_as_those_of_the_cpu():
    model = crowded()
    work, *_ = assembled(model, YES)
    free, matrix = model.free_vertices, work.method.matrix
    found = [
        cls(place, model.real, matrix, free, 10).label.numpy()
        for cls, place in ((RigidModes, model.device), (WideModes, Emulated()))
    ]
    assert np.array_equal(*found)
