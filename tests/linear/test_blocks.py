"""The Newton matrix and its solver against dense assembly and SciPy; the rigid modes of its preconditioner."""

import numpy as np
import pytest
import scipy.linalg
import warp as wp
from physics.scenes import cloth, floor, scene, solid

import pdipc
from pdipc.linear.block_pcg import BlockPcg
from pdipc.linear.rigid_modes import RigidModes
from pdipc.work import Work

YES, NO = (wp.array([value], dtype=wp.int32, device="cpu") for value in (1, 0))


def crowded(precision="float64", device="cpu"):
    """A block on the floor, turned so that it stretches, under a pinned sheet; all near enough to touch, with friction."""
    block = solid("block", (0.2, 0.2, 0.2), (3, 2, 2), at=(0, 0.104, 0), poisson=0.3, friction=0.3)
    pins = [{"select": {"nearest": [0.15, 0.21, 0.15]}}, {"select": {"nearest": [-0.15, 0.21, -0.15]}, "stiffness": 50.0}]
    sheet = cloth("sheet", [0.3, 0.3], [5, 5], at=(0, 0.21, 0), friction=0.3, pins=pins)
    contact = {"activation_distance": 1e-2}
    return pdipc.build(scene([block, sheet], [floor(1.0, friction=0.3)], contact=contact, precision=precision), device)


def assembled(model, project):
    """Work whose matrix, barriers and friction are those at a bent shape; u, and the contacts."""
    work, rng = Work(model), np.random.default_rng(0)
    x, n = model.initial_state().positions, model.vertex_count
    move = 1e-3 * rng.standard_normal((n, 3)) * model.free_vertices[:, None]
    u = wp.array(move, dtype=model.real.vec3, device="cpu")
    now = wp.array(x.numpy() + move, dtype=model.real.vec3, device="cpu")
    method = work.method
    work.list_pairs(now)
    method.grow()
    method.pairs.project = project
    method.pairs.differentiate(now)
    contacts = [method.pairs]
    if method.friction is not None:
        method.friction.grow()
        method.friction.lag()
        method.friction.differentiate(u, project)
        contacts.append(method.friction)
    method.matrix.assemble(x, u, project)
    return work, now, contacts


def elastic(model, matrix):
    """(3 n, 3 n) held I + the Hessians, element by element from the projector's blocks."""
    n, projector = model.vertex_count, model.projector
    found = np.kron(np.diag(matrix.held.numpy()), np.eye(3)).reshape(n, 3, n, 3)
    values, at = projector.blocks.numpy(), 0
    bending = {id(s) for s in projector.bending}
    for s in projector.sets:
        corners = s.vertices.shape[1]
        if id(s) not in bending:
            for vertices, g, w in zip(s.vertices, s.gradient, s.weight, strict=True):
                if corners > 1:  # attachments to points are held
                    found[np.ix_(vertices, range(3), vertices, range(3))] += np.einsum("ab,cd->acbd", w * g.T @ g, np.eye(3))
            continue
        for vertices in s.vertices:
            for a in range(corners):
                for b in range(a, corners):
                    if a != b:  # rows add up to zero
                        for i, j, block in ((vertices[a], vertices[b], values[at]), (vertices[b], vertices[a], values[at].T)):
                            found[i, :, j] += block
                            found[i, :, i] -= block
                    at += 1
    assert at == projector.block_count
    return found.reshape(3 * n, 3 * n)


def contact_matrix(contacts, n):
    """(3 n, 3 n): the sum over pairs of h l l^T, and of a_s a_t times the block of friction."""
    pairs, found = contacts[0], np.zeros((n, 3, n, 3))
    count = int(pairs.count.numpy()[0])
    for q, lever, h in zip(*(a.numpy()[:count] for a in (pairs.quads, pairs.lever, pairs.hessian)), strict=True):
        found[np.ix_(q, range(3), q, range(3))] += h * np.einsum("ai,bj->aibj", lever, lever)
    for term in contacts[1:]:
        for q, a, block in zip(*(v.numpy()[:count] for v in (term.quads, term.weights, term.block)), strict=True):
            found[np.ix_(q, range(3), q, range(3))] += np.einsum("a,b,ij->aibj", a, a, block)
    return found.reshape(3 * n, 3 * n)


def on_free(dense, free):
    inside = np.repeat(free, 3)
    return dense[np.ix_(inside, inside)]


def blocked(matrix):
    """(3 n, 3 n) of the stored blocks and the diagonal."""
    n, nnz = matrix.count, matrix.nnz
    arrays = (matrix.values.numpy()[:nnz], matrix.columns.numpy()[:nnz], matrix.offsets.numpy())
    rows = np.repeat(np.arange(n), np.diff(arrays[2]))
    found = np.zeros((n, 3, n, 3))
    found[rows, :, arrays[1]] = arrays[0]
    found[np.arange(n), :, np.arange(n)] = matrix.diagonal.numpy()
    return found.reshape(3 * n, 3 * n)


@pytest.mark.parametrize("project", [NO, YES], ids=["exact", "projected"])
def test_blocks_are_those_of_dense_assembly(project):
    """Rows of free vertices, with columns to pinned ones."""
    model = crowded()
    work, _, _ = assembled(model, project)
    expected = elastic(model, work.method.matrix)
    rows = np.repeat(model.free_vertices, 3)
    assert 0 < (~model.free_vertices).sum() < model.vertex_count
    assert np.abs(blocked(work.method.matrix) - expected)[rows].max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("group", [None, 4], ids=["one group a body", "small groups"])
def test_solution_is_that_of_scipy(group):
    """Elastic blocks, barriers and friction together, with pinned vertices that move."""
    model = crowded()
    work, now, contacts = assembled(model, YES)
    n, free, matrix = model.vertex_count, model.free_vertices, work.method.matrix
    solver = BlockPcg(model.device, model.real, matrix, free, 1e-10, 600)
    if group:
        solver.modes = RigidModes(model.device, model.real, matrix, free, group)
        assert solver.modes.groups > 10
    rng = np.random.default_rng(1)
    k = elastic(model, matrix) + contact_matrix(contacts, n)
    b, start = rng.standard_normal((n, 3)) * free[:, None], 1e-3 * rng.standard_normal((n, 3)) * ~free[:, None]
    p = wp.array(np.append(start, np.zeros((1, 3)), axis=0), dtype=wp.vec3d, device="cpu")
    solver.prepare(now, contacts)
    solver.solve(p, wp.array(b, dtype=wp.vec3d, device="cpu"), contacts, 0.0, NO)
    inside = np.repeat(free, 3)
    right = b.ravel()[inside] - k[np.ix_(inside, ~inside)] @ start.ravel()[~inside]
    expected = scipy.linalg.solve(on_free(k, free), right, assume_a="pos")
    found = p.numpy()[:n].ravel()
    assert np.array_equal(found[~inside], start.ravel()[~inside])
    assert np.abs(found[inside] - expected).max() < 1e-6 * np.abs(expected).max()
    assert 0 < solver.iterations.numpy()[0] < 600
    assert solver.indefinite.numpy()[0] == 0


def test_solution_for_bodies_that_follow_four_points():
    """J^T K J q = J^T b, densely: a rigid box under a sheet that is attached to it, both in contact, with friction, on the floor."""
    box = {
        "name": "box",
        "kind": "rigid",
        "mesh": {"shape": "box", "size": (0.2, 0.2, 0.2), "cells": (3, 2, 2)},
        "friction": 0.3,
    }
    box.update(translation=(0, 0.104, 0), pins=[{"select": {"vertices": [0]}, "stiffness": 300.0}])
    sheet = cloth(
        "sheet", [0.3, 0.3], [5, 5], at=(0, 0.21, 0), friction=0.3, pins=[{"select": {"nearest": [0.15, 0.21, 0.15]}}]
    )
    ties = [{"bodies": ("sheet", "box"), "pairs": [[14, 3], [15, 4]], "stiffness": 100.0}]
    made = scene([box, sheet], [floor(1.0, friction=0.3)], contact={"activation_distance": 1e-2})
    model = pdipc.build(
        made.model_copy(update={"attachments": pdipc.Scene(**{**made.model_dump(), "attachments": ties}).attachments}), "cpu"
    )
    work, now, contacts = assembled(model, YES)
    n, free, matrix = model.vertex_count, model.free_vertices, work.method.matrix
    solver = BlockPcg(model.device, model.real, matrix, free, 1e-11, 900, work.method.affine)
    (body,) = model.followers
    follow = np.eye(n)
    follow[body.vertices] = 0.0
    follow[np.ix_(body.vertices, body.handles)] = body.weights
    unknown = free.copy()
    unknown[body.vertices] = False
    j = np.kron(follow[:, unknown], np.eye(3))
    k = elastic(model, matrix) + contact_matrix(contacts, n)
    b = np.random.default_rng(1).standard_normal((n, 3)) * free[:, None]
    p = wp.zeros(n + 1, dtype=wp.vec3d, device="cpu")
    solver.prepare(now, contacts)
    solver.solve(p, wp.array(b, dtype=wp.vec3d, device="cpu"), contacts, 0.0, NO)
    expected = j @ scipy.linalg.solve(j.T @ k @ j, j.T @ b.ravel(), assume_a="pos")
    assert np.abs(p.numpy()[:n].ravel() - expected).max() < 1e-6 * np.abs(expected).max()
    assert 0 < solver.iterations.numpy()[0] < 300


def test_coarse_matrix_is_the_galerkin_product():
    """C = Z^T K Z, with barriers and friction, whose triangle is factorized in place: C^-1 Z^T r against NumPy."""
    model = crowded()
    work, now, contacts = assembled(model, YES)
    n, free, matrix = model.vertex_count, model.free_vertices, work.method.matrix
    modes = RigidModes(model.device, model.real, matrix, free, 10)
    assert 4 < modes.groups <= 48
    modes.prepare(now, contacts)
    label, arms = modes.label.numpy()[:n], modes.arms.numpy()
    z = np.zeros((n, 3, modes.groups, 6))
    for i in np.flatnonzero(label >= 0):
        z[i, :, label[i], :3] = np.eye(3)
        z[i, :, label[i], 3:] = np.cross(np.eye(3), arms[i]).T
    z = z.reshape(3 * n, -1)
    k = elastic(model, matrix) + contact_matrix(contacts, n)
    r = np.random.default_rng(2).standard_normal((n, 3)) * free[:, None]
    modes.restrict(wp.array(r, dtype=wp.vec3d, device="cpu"))
    expected = scipy.linalg.solve(z.T @ k @ z, z.T @ r.ravel(), assume_a="pos")
    assert np.abs(modes.z.numpy().ravel() - expected).max() < 1e-8 * np.abs(expected).max()


def test_a_direction_of_negative_curvature_is_reported():
    """A spring pressed hard is unstable across it: exact blocks are indefinite, projected ones are not."""
    sheet = cloth("sheet", [0.3, 0.3], [4, 4], material={"membrane": "springs", "membrane_stiffness": 1e4})
    model = pdipc.build(scene([sheet]), "cpu")
    work, x = Work(model), model.initial_state().positions
    u = wp.array(-0.3 * x.numpy(), dtype=wp.vec3d, device="cpu")
    for project, indefinite in ((NO, 1), (YES, 0)):
        work.method.matrix.assemble(x, u, project)
        lowest = np.linalg.eigvalsh(elastic(model, work.method.matrix))[0]
        assert (lowest < 0.0) == bool(indefinite)
        solver = work.method.solver
        b = np.random.default_rng(0).standard_normal((len(x), 3))
        p = wp.zeros(len(x) + 1, dtype=wp.vec3d, device="cpu")
        solver.prepare(x, [])
        solver.solve(p, wp.array(b, dtype=wp.vec3d, device="cpu"), [], 0.0, NO)
        assert solver.indefinite.numpy()[0] == indefinite


def test_a_preconditioner_of_negative_curvature_is_reported():
    """Pressed harder, single vertices are unstable too: then r . M^-1 r turns negative, which is no small residual."""
    sheet = cloth("sheet", [0.3, 0.3], [4, 4], material={"membrane": "springs", "membrane_stiffness": 1e4})
    model = pdipc.build(scene([sheet]), "cpu")
    work, x = Work(model), model.initial_state().positions
    u = wp.array(-0.8 * x.numpy(), dtype=wp.vec3d, device="cpu")
    work.method.matrix.assemble(x, u, NO)
    assert np.linalg.eigvalsh(work.method.matrix.diagonal.numpy()[: len(x)]).max() < 0.0
    solver, b = work.method.solver, np.zeros((len(x), 3))
    b[3, 1] = 1.0
    p = wp.zeros(len(x) + 1, dtype=wp.vec3d, device="cpu")
    solver.prepare(x, [])
    solver.solve(p, wp.array(b, dtype=wp.vec3d, device="cpu"), [], 0.0, NO)
    assert solver.indefinite.numpy()[0] == 1


@pytest.mark.parametrize("motion", ["translation", "rotation"])
def test_rigid_motions_of_a_stiff_body_in_single_precision(motion):
    """Steel, 3 m from the origin: what moves it rigidly is found as such, at once. Positions alone would lie: their rounding is stress."""
    block = solid("block", (0.1, 0.1, 0.1), (4, 4, 4), at=(3.0, 1.0, 2.0), young=2e11, poisson=0.3, density=7850.0)
    model = pdipc.build(scene([block], contact={"activation_distance": 5e-2}, precision="float32"), "cpu")
    work, state = Work(model), model.initial_state()
    x, matrix = state.positions, work.method.matrix
    assert np.abs(state.remainders.numpy()).max() > 1e-9
    matrix.assemble(x, state.remainders, NO)
    arm = model.assembly.positions - model.assembly.positions.mean(axis=0)
    expected = np.tile([1.0, 2.0, -1.0], (len(arm), 1)) if motion == "translation" else np.cross([1.0, -2.0, 0.5], arm)
    b = wp.array((matrix.held.numpy()[:, None] * expected).astype(np.float32), dtype=wp.vec3, device="cpu")
    p, solver = wp.zeros(len(arm) + 1, dtype=wp.vec3, device="cpu"), work.method.solver
    solver.prepare(x, [])
    solver.solve(p, b, [], 0.0, NO)
    found = p.numpy()[: len(arm)]
    assert np.abs(found - expected).max() < (1e-6 if motion == "translation" else 0.05) * np.abs(expected).max()
    assert solver.iterations.numpy()[0] <= 5
