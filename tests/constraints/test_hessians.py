"""Hessians of every kind that bends: against differences of forces as they are, and positive semidefinite where that is asked for."""

import itertools

import numpy as np
import pytest
import warp as wp

from pdipc import constraints
from pdipc.constraints import (
    corotated,
    curved_bending,
    edge_length,
    enclosed_volume,
    neo_hookean,
    rod_bending,
    rod_frames,
    rod_ghost,
    stitch,
    strain_limit,
    surface_attachment,
    tet_strain,
    tet_volume,
    triangle_area,
    triangle_strain,
    woven,
)
from pdipc.device.launch import Device
from pdipc.device.precision import real

SOLIDS = (tet_strain, tet_volume, corotated, neo_hookean)
SHEETS = (triangle_strain, triangle_area, woven, strain_limit)
RODS = (rod_bending, rod_frames, rod_ghost)
DEVICE, PRECISION = Device("cpu", threads=1), real("float64")
STEP, RELATIVE = 1e-5, 1e-6  # m of the differences, and what they are good for, of elements of about a metre


def stretches(kind):
    """Singular values: at rest, pulled, pressed, sheared, flat, and for solids turned inside out. Where the energy has no kink."""
    if kind in SOLIDS:
        found = [[1, 1, 1], [1.3, 1.1, 0.9], [0.7, 0.8, 0.6], [2.0, 0.5, 1.1], [1.2, 0.9, 1e-3], [1.4, 0.8, -0.3]]
        return found if kind is not tet_volume else [s for s in found if min(s) > 0.01]  # its nearest matrix jumps there
    if kind is strain_limit:  # of 2: slack, near it on one side, on both, past it, past where the parabola begins
        return [[1.5, 0.9], [2.9, 0.8], [2.95, 2.951], [3.0, 1.5], [3.2, 2.9]]
    found = [[1, 1], [1.3, 1.1], [0.7, 0.8], [2.0, 0.6], [1.3, 0.05]]
    return found if kind in (triangle_strain, woven) else found[:-1]


def elements(kind, rng):
    """Rest positions, present ones and a set, whose elements do not touch each other."""
    if kind in SOLIDS or kind in SHEETS:
        size = 3 if kind in SOLIDS else 2
        rest, now, vertices = [], [], []
        for s in stretches(kind):
            x = np.concatenate([np.zeros((1, size)), np.eye(size)]) + 0.1 * rng.standard_normal((size + 1, size))
            u, _ = np.linalg.qr(rng.standard_normal((3, size)))
            v, _ = np.linalg.qr(rng.standard_normal((size, size)))
            if kind in SOLIDS:
                u, v = u * np.linalg.det(u), v * np.linalg.det(v)
            rest.append(np.pad(x, ((0, 0), (0, 3 - size))))
            now.append(x @ (u @ np.diag(np.asarray(s, dtype=float)) @ v.T).T)
            vertices.append(np.arange(size + 1) + (size + 1) * len(vertices))
        rest, now, vertices = np.concatenate(rest), np.concatenate(now), np.array(vertices, dtype=np.int32)
        if kind in (corotated, neo_hookean):
            return rest, now, kind.rest(rest, vertices, 1.5, 2.5)
        if kind is woven:
            return rest, now, kind.rest(rest, vertices, (3.0, 1.0, 0.5, 0.7), (1.0, 0.4, 0.0))
        if kind is strain_limit:
            return rest, now, kind.rest(rest, vertices, 2.0, 2.0)
        return rest, now, kind.rest(rest, vertices, 2.0)
    if kind is stitch:  # loose, taut, and of no length
        rest = rng.standard_normal((12, 3))
        weights = np.array([[0.2, 0.3, 0.5], [0.6, 0.4, 0.0], [1.0, 0.0, 0.0]])
        return rest, rest, stitch.rest(np.arange(12).reshape(3, 4), weights, 2.0, [9.0, 0.3, 0.0])
    if kind is surface_attachment:
        rest = rng.standard_normal((12, 3))
        weights = np.array([[0.2, 0.3, 0.5], [0.6, 0.4, 0.0], [1.0, 0.0, 0.0]])
        now = rest + 0.3 * rng.standard_normal(rest.shape)
        return rest, now, kind.rest(rest, np.arange(12).reshape(3, 4), weights, 2.0)
    if kind is edge_length:
        rest = rng.standard_normal((8, 3))
        vertices = np.arange(8, dtype=np.int32).reshape(4, 2)
        now = rest.copy()
        for e, pull in enumerate((1.0, 1.5, 0.5, 0.1)):
            now[2 * e + 1] = now[2 * e] + pull * (rest[2 * e + 1] - rest[2 * e])
        return rest, now, kind.rest(rest, vertices, 2.0)
    if kind in RODS:
        corners = kind.CORNERS
        straight = np.array([[0, 0, 0], [1, 0, 0], [2.1, 0, 0]][: 2 if kind is rod_ghost else 3], dtype=float)
        ghosts = np.array([[0.5, 0.4, 0], [1.6, 0, -0.5]][: corners - len(straight)], dtype=float).reshape(-1, 3)
        each = np.concatenate([straight, ghosts])
        rest = np.concatenate([each + 0.1 * k * rng.standard_normal(each.shape) for k in range(5)])
        vertices = np.arange(5 * corners, dtype=np.int32).reshape(5, corners)
        stiffness = (2.0, 3.0) if kind is rod_frames else (2.0,)
        return rest, rest + 0.3 * rng.standard_normal(rest.shape), kind.rest(rest, vertices, *stiffness)
    hinge = np.array([[0, 0, 0], [1, 0, 0], [0.4, 0.8, 0.3], [0.6, -0.9, 0.2]])
    rest = np.concatenate([hinge + 0.1 * rng.standard_normal((4, 3)) for _ in range(5)])
    triangles = np.array([t for k in range(0, 20, 4) for t in ([k, k + 1, k + 2], [k + 1, k, k + 3])], dtype=np.int32)
    return rest, rest + 0.2 * rng.standard_normal(rest.shape), kind.rest(rest, triangles, 2.0)


def upload(x):
    return wp.array(x, dtype=PRECISION.vec3, device="cpu")


def force_of_elements(projector, base, u, vertices):
    """(e, c, 3); elements do not touch each other."""
    none, out = wp.zeros(len(base), dtype=PRECISION.vec3, device="cpu"), wp.zeros(len(base), dtype=PRECISION.vec3, device="cpu")
    projector.add_forces(upload(base), upload(u), out, none)
    return out.numpy()[vertices]


def differences(projector, base, u, vertices):
    """(e, 3 c, 3 c): minus the derivative of the forces."""
    count, corners = vertices.shape
    found = np.zeros((count, 3 * corners, 3 * corners))
    for c in range(corners):
        for axis in range(3):
            moved = np.zeros_like(u)
            moved[vertices[:, c], axis] = STEP
            change = force_of_elements(projector, base, u + moved, vertices) - force_of_elements(
                projector, base, u - moved, vertices
            )
            found[:, :, 3 * c + axis] = -change.reshape(count, -1) / (2 * STEP)
    return found


def blocks(projector, base, u, corners, project):
    """(e, 3 c, 3 c): what the projector makes of the blocks of corners a < b, whose rows add up to zero."""
    projector.differentiate(upload(base), upload(u), wp.array([project], dtype=wp.int32, device="cpu"))
    values = projector.blocks.numpy().reshape(-1, corners * (corners + 1) // 2, 3, 3)
    found = np.zeros((len(values), corners, 3, corners, 3))
    for k, (a, b) in enumerate(itertools.combinations_with_replacement(range(corners), 2)):
        if a != b:
            found[:, b, :, a] = np.swapaxes(values[:, k], 1, 2)
            found[:, a, :, b] = values[:, k]
            found[:, a, :, a] -= found[:, a, :, b]
            found[:, b, :, b] -= found[:, b, :, a]
    return found.reshape(len(values), 3 * corners, 3 * corners)


def prepared(kind, seed=0):
    rest, now, s = elements(kind, np.random.default_rng(seed))
    projector = constraints.Projector(DEVICE, PRECISION, len(rest), [s])
    (s,) = projector.bending
    return projector, rest, now - rest, s.vertices


ROWS = [*SOLIDS, *SHEETS, edge_length, curved_bending, stitch, surface_attachment, rod_bending]
BENDING = [*ROWS, rod_frames, rod_ghost]


def test_every_kind_that_bends_is_tested():
    bends = {kind for kind in constraints.KINDS if hasattr(kind.kernels(PRECISION), "hessian")}
    assert bends == {*BENDING, enclosed_volume}  # of a closed surface as a whole: test_enclosed_volume


@pytest.mark.parametrize("kind", BENDING, ids=lambda kind: kind.NAME)
def test_hessians_are_derivatives_of_forces(kind):
    projector, base, u, vertices = prepared(kind)
    expected = differences(projector, base, u, vertices)
    for e, found in enumerate(blocks(projector, base, u, vertices.shape[1], 0)):
        assert np.abs(found - expected[e]).max() <= RELATIVE * np.abs(expected[e]).max(), f"element {e}"


@pytest.mark.parametrize("kind", ROWS, ids=lambda kind: kind.NAME)
def test_projected_hessians_are_the_nearest_positive_semidefinite(kind):
    """In terms of F, or G x: on its derivative G the negative eigenvalues are zero, and the others what they were."""
    projector, base, u, vertices = prepared(kind)
    (s,) = projector.bending
    exact, projected = (blocks(projector, base, u, vertices.shape[1], flag) for flag in (0, 1))
    changed = 0
    for e in range(len(vertices)):
        g = np.kron(s.gradient[e], np.eye(3))
        back = np.linalg.pinv(g)
        own, nearest = back.T @ exact[e] @ back, back.T @ projected[e] @ back
        value, vector = np.linalg.eigh(0.5 * (own + own.T))
        expected = vector @ np.diag(np.maximum(value, 0.0)) @ vector.T
        if kind is not woven:  # projects its parts, which is positive, but not the nearest
            assert np.abs(nearest - expected).max() <= 1e-9 * np.abs(own).max(), f"element {e}"
        assert np.linalg.eigvalsh(projected[e])[0] >= -1e-12 * np.abs(projected[e]).max()
        changed += value[0] < -1e-9
    assert changed > 0 or kind in (stitch, strain_limit)  # which are convex


@pytest.mark.parametrize("kind", SOLIDS + SHEETS, ids=lambda kind: kind.NAME)
@pytest.mark.parametrize("project", [0, 1])
def test_degenerate_elements_have_finite_hessians(kind, project):
    """Points, lines and flat elements, wound both ways: also where the energy has a kink, numbers stay numbers."""
    rng = np.random.default_rng(3)
    rest, _, s = elements(kind, rng)
    size = s.vertices.shape[1] - 1
    now = rest.copy()
    flat = [np.zeros((size, 3)), np.outer(np.ones(size), [1.0, 0, 0]), np.pad(np.eye(size)[:, :1], ((0, 0), (0, 2)))]
    flat.append(-np.pad(np.eye(size), ((0, 0), (0, 3 - size))))
    for e, edges in enumerate(flat):
        now[s.vertices[e, 0]] = 0.0
        now[s.vertices[e, 1:]] = edges
    projector = constraints.Projector(DEVICE, PRECISION, len(rest), [s])
    found = blocks(projector, rest, now - rest, size + 1, project)
    assert np.isfinite(found).all()
    if project:
        assert all(np.linalg.eigvalsh(h)[0] > -1e-9 * (1.0 + np.abs(h).max()) for h in found)


@pytest.mark.parametrize("kind", [rod_frames, rod_ghost], ids=lambda kind: kind.NAME)
def test_hessians_of_rods_are_semidefinite_where_that_is_asked_for(kind):
    """And what they were at rest, where nothing is to be left out."""
    projector, base, u, vertices = prepared(kind)
    for now, same in ((u, False), (np.zeros_like(u), kind is rod_frames)):
        exact, projected = (blocks(projector, base, now, vertices.shape[1], flag) for flag in (0, 1))
        for e in range(len(vertices)):
            size = np.abs(projected[e]).max()
            assert np.linalg.eigvalsh(projected[e])[0] >= -1e-12 * size
            assert not same or np.abs(projected[e] - exact[e]).max() < 1e-12 * size
