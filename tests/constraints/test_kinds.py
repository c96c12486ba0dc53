"""Every kind of constraint: rest, rigid motion, gradient, optimal projection, the constant matrix, the gather."""

import numpy as np
import pytest
import warp as wp
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from pdipc import constraints
from pdipc.constraints import (
    axis_attachment,
    corotated,
    curved_bending,
    edge_length,
    enclosed_volume,
    material,
    neo_hookean,
    point_attachment,
    quadratic_bending,
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
    woven_bending,
)
from pdipc.constraints.rotation import nearest_rotation
from pdipc.device.launch import Device
from pdipc.device.precision import real

DEVICE = Device("cpu", threads=1)
REST_ENERGY = 1e-18  # J, of elements with weights of about one; more where the energy is a difference of such that are not zero
GRADIENT = 1e-6  # relative, central differences in float64


def tet_mesh(rng):
    """Two tets that share a face."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1.0]]) + 0.1 * rng.standard_normal((5, 3))
    return x, np.array([[0, 1, 2, 3], [1, 2, 3, 4]], dtype=np.int32)


def sheet(rng, height=0.0):
    """A 4 x 4 grid of vertices in the plane z = 0, or on a saddle."""
    i, j = np.meshgrid(np.arange(4), np.arange(4), indexing="ij")
    x = np.stack([i, j, height * (i - 1.5) * (j - 1.5)], axis=-1).reshape(-1, 3).astype(float)
    quads = [(a * 4 + b, (a + 1) * 4 + b, (a + 1) * 4 + b + 1, a * 4 + b + 1) for a in range(3) for b in range(3)]
    triangles = np.array([t for q in quads for t in ((q[0], q[1], q[2]), (q[0], q[2], q[3]))], dtype=np.int32)
    return x, triangles


def make(kind, rng):
    """Rest positions and a set of the kind."""
    if kind in (tet_strain, tet_volume):
        x, tets = tet_mesh(rng)
        return x, kind.rest(x, tets, 2.0)
    if kind in (corotated, neo_hookean):
        x, tets = tet_mesh(rng)
        return x, kind.rest(x, tets, 2.0, 3.0)
    if kind is enclosed_volume:
        x, tets = tet_mesh(rng)
        surface = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 4], [1, 4, 3], [2, 3, 4]], dtype=np.int32)
        cavity = enclosed_volume.cavities(surface)
        volume = enclosed_volume.volumes(x, surface, cavity)
        assert (cavity == 0).all() and volume[0] == pytest.approx(np.abs(tet_volume.rest(x, tets, 1.0).weight).sum())
        return x, kind.rest(
            surface, cavity, np.column_stack([0 * volume - 2.0, 0 * volume + 2.0, 0 * volume + 1.4, 0 * volume + 3.0, volume])
        )
    if kind is stitch:
        x = rng.standard_normal((8, 3))
        weights = np.array([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0]])
        distance = np.linalg.norm(np.einsum("ek,ekd->ed", weights, x.reshape(2, 4, 3)[:, 1:]) - x[::4], axis=1)
        return x, kind.rest(np.arange(8).reshape(2, 4), weights, 2.0, distance)
    if kind is surface_attachment:
        x = rng.standard_normal((8, 3))
        return x, kind.rest(x, np.arange(8).reshape(2, 4), np.array([[0.2, 0.3, 0.5], [1.0, 0.0, 0.0]]), 2.0)
    if kind is point_attachment:
        x = rng.standard_normal((4, 3))
        return x, kind.rest(x[:3], np.arange(3), 2.0)
    if kind is axis_attachment:
        x = rng.standard_normal((4, 3))
        return x, kind.rest(x[:3], np.arange(3), [[1, 0, 0], [0, 1, 1], [1, 1, 1]], 2.0)
    if kind in (rod_bending, rod_frames, rod_ghost):
        # a bent chain of three segments with their ghost points
        x = np.array([[0, 0, 0], [1, 0, 0], [2, 0.3, 0], [2.7, 1, 0.2], [0.5, 0.5, 0], [1.5, 0.15, 0.6], [2.85, 0.15, 0.1]])
        joints = np.array([[0, 1, 2, 4, 5], [1, 2, 3, 5, 6]], dtype=np.int32)
        if kind is rod_frames:
            return x, kind.rest(x, joints, 2.0, 3.0)
        return x, kind.rest(x, joints[:, :3] if kind is rod_bending else joints[:, [0, 1, 3]], 2.0)
    x, triangles = sheet(rng, height=0.2 if kind is curved_bending else 0.0)
    if kind is edge_length:
        return x, kind.rest(x, triangles[:, :2], 2.0)
    if kind is woven:
        return x, kind.rest(x, triangles, (3.0, 1.0, 0.5, 0.7), (1.0, 0.4, 0.0))
    if kind is woven_bending:
        return x, kind.rest(x, triangles, 3.0, 0.5, (1.0, 0.4, 0.0))
    if kind is strain_limit:
        return x, kind.rest(x, triangles, 2.0, 0.3)
    return x, kind.rest(x, triangles, 2.0)


def energy(x, s, precision="float64"):
    number = real(precision)
    projector = constraints.Projector(DEVICE, number, len(x), [s])
    out, u = wp.zeros(1, dtype=number.scalar, device="cpu"), wp.zeros(len(x), dtype=number.vec3, device="cpu")
    projector.energy(wp.array(x, dtype=number.vec3, device="cpu"), u, out, 0)
    return float(out.numpy()[0])


def forces(x, sets, precision="float64", threads=1):
    number, device = real(precision), Device("cpu", threads=threads)
    projector = constraints.Projector(device, number, len(x), sets)
    u, none, out = (wp.zeros(len(x), dtype=number.vec3, device="cpu") for _ in range(3))
    projector.add_forces(wp.array(x, dtype=number.vec3, device="cpu"), u, out, none)
    return out.numpy()


def rotation(rng):
    q, _ = np.linalg.qr(rng.standard_normal((3, 3)))
    return q * np.sign(np.linalg.det(q))


@pytest.mark.parametrize("kind", constraints.KINDS, ids=lambda kind: kind.NAME)
def test_energy_is_zero_at_rest_and_under_rigid_motion(kind):
    rng = np.random.default_rng(1)
    x, s = make(kind, rng)
    assert abs(energy(x, s)) < (REST_ENERGY if kind.PROJECTIVE else REST_ENERGY * 1e3)
    if kind not in (point_attachment, axis_attachment):
        assert abs(energy(x @ rotation(rng).T + rng.standard_normal(3), s)) < REST_ENERGY * 1e6


@pytest.mark.parametrize("kind", constraints.KINDS, ids=lambda kind: kind.NAME)
def test_forces_are_the_negative_gradient_of_the_energy(kind):
    rng = np.random.default_rng(2)
    x, s = make(kind, rng)
    x = x + 0.1 * rng.standard_normal(x.shape)
    step, direction = 1e-5, rng.standard_normal(x.shape)
    slope = (energy(x + step * direction, s) - energy(x - step * direction, s)) / (2 * step)
    work = -(forces(x, [s]) * direction).sum()
    assert work == pytest.approx(slope, rel=GRADIENT, abs=1e-8)


@pytest.mark.parametrize("kind", [kind for kind in constraints.KINDS if kind.PROJECTIVE], ids=lambda kind: kind.NAME)
def test_matrix_minus_targets_is_the_force(kind):
    """A x of the constant matrix less w G^T p is minus the force: for the kinds whose target is zero, A x alone is."""
    rng = np.random.default_rng(3)
    x, s = make(kind, rng)
    matrix = constraints.stiffness_matrix(len(x), [s])
    assert abs(matrix - matrix.T).max() < 1e-12
    dense = np.zeros((len(x), len(x)))
    for e in range(len(s)):
        np.add.at(dense, np.ix_(s.vertices[e], s.vertices[e]), s.weight[e] * s.gradient[e].T @ s.gradient[e])
    np.testing.assert_allclose(matrix.toarray(), dense, atol=1e-12)
    if kind in (quadratic_bending, woven_bending):
        x = x + rng.standard_normal(x.shape)
        np.testing.assert_allclose(forces(x, [s]), -dense @ x, atol=1e-9)


def test_along_free_axes_nothing_is_held():
    rng = np.random.default_rng(5)
    x, s = make(axis_attachment, rng)
    away = rng.standard_normal(x.shape)
    np.testing.assert_allclose(forces(x + away, [s])[:3], -2.0 * away[:3] * s.data["axes"], atol=1e-12)


def test_strain_projects_to_the_nearest_rotation():
    """Against NumPy's SVD on near-rotations, stretched, inverted, flat, rank-one and zero matrices."""
    rng = np.random.default_rng(4)
    project = nearest_rotation
    cases = [rng.standard_normal((3, 3)) for _ in range(200)]
    cases += [
        rotation(rng) @ np.diag([1, 1, -1.0]),
        np.diag([1, 1, 0.0]),
        np.diag([2.0, 0, 0]),
        1e-9 * np.eye(3),
        1e9 * np.eye(3),
    ]
    cases += [rotation(rng) * scale + 1e-3 * scale * rng.standard_normal((3, 3)) for scale in (1e-6, 1.0, 1e6)]
    for f in cases:
        p = np.array(project(wp.mat33d(*f.ravel()))).reshape(3, 3)
        np.testing.assert_allclose(p.T @ p, np.eye(3), atol=1e-12)
        assert np.linalg.det(p) > 0
        u, s, vt = np.linalg.svd(f)
        s = s * [1, 1, np.sign(np.linalg.det(u @ vt))]
        best = (f**2).sum() - 2 * s.sum() + 3
        assert ((f - p) ** 2).sum() <= best + 1e-10 * max(1.0, (f**2).sum())
    identity = np.array(project(wp.mat33d())).reshape(3, 3)
    np.testing.assert_allclose(identity, np.eye(3))


def test_rotation_in_float32_is_as_good_as_float32_allows():
    rng = np.random.default_rng(5)
    project = nearest_rotation
    for _ in range(200):
        f = rng.standard_normal((3, 3)).astype(np.float32)
        p = np.array(project(wp.mat33(*f.ravel()))).reshape(3, 3)
        u, s, vt = np.linalg.svd(f.astype(np.float64))
        s = s * [1, 1, np.sign(np.linalg.det(u @ vt))]
        best = (f.astype(np.float64) ** 2).sum() - 2 * s.sum() + 3
        assert ((f - p) ** 2).sum() <= best + 1e-4 * (1 + abs(best))
        np.testing.assert_allclose(p.T @ p, np.eye(3), atol=1e-5)


def test_rotation_in_float32_of_inverted_matrices():
    """The rotation may turn by rounding over s2 + s3 and no more, also where a SVD has to find it."""
    rng = np.random.default_rng(9)
    project = nearest_rotation
    for gap in (0.3, 0.1, 0.03, 0.01):
        for _ in range(25):
            u, v = rotation(rng), rotation(rng)
            f = (u @ np.diag([1.0, 0.6, gap - 0.6]) @ v.T).astype(np.float32)
            a, _, bt = np.linalg.svd(f.astype(np.float64))
            nearest = a @ np.diag([1.0, 1.0, np.linalg.det(a @ bt)]) @ bt
            p = np.array(project(wp.mat33(*f.ravel()))).reshape(3, 3)
            assert np.abs(p - nearest).max() < 1e-6 + 3e-7 / gap


def test_volume_projection_is_nearest_among_its_neighbours():
    """No matrix of determinant one around the projection is nearer: moves along the manifold do not get closer."""
    rng = np.random.default_rng(6)
    project = tet_volume.project
    for _ in range(50):
        f = np.eye(3) + 0.3 * rng.standard_normal((3, 3))
        p = np.array(project(wp.mat33d(*f.ravel()))).reshape(3, 3)
        assert np.linalg.det(p) == pytest.approx(1.0, abs=1e-9)
        for _ in range(20):
            q = p + 1e-3 * rng.standard_normal((3, 3))
            q /= np.cbrt(np.linalg.det(q))
            assert ((f - q) ** 2).sum() >= ((f - p) ** 2).sum() - 1e-9


def columns(p):
    return np.array(p).reshape(2, 3).T


def test_triangle_projections_are_nearest():
    """Isometry: against the SVD. Area: determinant one, and no neighbour of area one in the plane is nearer."""
    rng = np.random.default_rng(7)
    isometry = triangle_strain.project
    area = triangle_area.project
    for _ in range(100):
        f = rng.standard_normal((3, 2))
        p = columns(isometry(wp.vec3d(*f[:, 0]), wp.vec3d(*f[:, 1])))
        u, _, vt = np.linalg.svd(f, full_matrices=False)
        np.testing.assert_allclose(p, u @ vt, atol=1e-10)
        f = u @ np.diag(1 + 0.3 * rng.standard_normal(2)) @ vt
        q = columns(area(wp.vec3d(*f[:, 0]), wp.vec3d(*f[:, 1])))
        assert np.linalg.norm(np.cross(q[:, 0], q[:, 1])) == pytest.approx(1.0, abs=1e-9)
        for _ in range(10):
            near = q @ (np.eye(2) + 1e-3 * rng.standard_normal((2, 2)))
            near /= np.sqrt(np.linalg.norm(np.cross(near[:, 0], near[:, 1])))
            assert ((f - near) ** 2).sum() >= ((f - q) ** 2).sum() - 1e-9
    for f in (np.zeros((3, 2)), np.array([[1.0, 2.0], [0, 0], [0, 0]])):
        p = columns(isometry(wp.vec3d(*f[:, 0]), wp.vec3d(*f[:, 1])))
        np.testing.assert_allclose(p.T @ p, np.eye(2), atol=1e-12)


def test_gather_has_the_same_bits_for_any_number_of_threads():
    rng = np.random.default_rng(8)
    i = np.stack(np.meshgrid(*[np.arange(16)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    x = i + 0.1 * rng.standard_normal(i.shape)
    corner = i[(i < 15).all(axis=1)] @ [256, 16, 1]
    tets = np.stack([corner, corner + 256, corner + 16, corner + 1], axis=1).astype(np.int32)
    sets = [tet_strain.rest(i.astype(float), tets, 1.0), edge_length.rest(i.astype(float), tets[:, :2], 3.0)]
    for precision in ("float64", "float32"):
        one = forces(x, sets, precision, threads=1)
        for threads in (2, 3):
            np.testing.assert_array_equal(forces(x, sets, precision, threads), one)
    np.testing.assert_allclose(forces(x, sets, "float32"), forces(x, sets), atol=2e-5)


@pytest.mark.parametrize("model", ["arap", "corotated", "neo_hookean"])
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45])
def test_small_strains_follow_hookes_law(poisson, model):
    """Energy of a uniaxial strain, with free contraction, is E e^2 V / 2; of a pure volume change, K tr^2 V / 2."""
    rng = np.random.default_rng(9)
    x, tets = tet_mesh(rng)
    young, strain = 3.0, 1e-4
    w_strain, w_volume = material.solid(young, poisson)
    sets = [tet_strain.rest(x, tets, w_strain), tet_volume.rest(x, tets, w_volume)]
    if model != "arap":
        kind = corotated if model == "corotated" else neo_hookean
        sets = [kind.rest(x, tets, young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson)))]
    volume = tet_volume.rest(x, tets, 1.0).weight.sum()
    stretched = x * (1 + strain * np.array([1, -poisson, -poisson]))
    assert sum(energy(stretched, s) for s in sets) == pytest.approx(0.5 * young * strain**2 * volume, rel=1e-3)
    bulk = young / (3 * (1 - 2 * poisson))
    grown = x * (1 + strain / 3)
    assert sum(energy(grown, s) for s in sets) == pytest.approx(0.5 * bulk * strain**2 * volume, rel=1e-3)


@pytest.mark.parametrize("poisson", [0.0, 0.3])
def test_small_membrane_strains_follow_plane_stress(poisson):
    x, triangles = sheet(np.random.default_rng(10))
    stiffness, strain = 7.0, 1e-4
    w_strain, w_area = material.cloth(stiffness, poisson)
    sets = [triangle_strain.rest(x, triangles, w_strain), triangle_area.rest(x, triangles, w_area)]
    stretched = x * (1 + strain * np.array([1, -poisson, 0]))
    assert sum(energy(stretched, s) for s in sets) == pytest.approx(0.5 * stiffness * strain**2 * 9.0, rel=1e-3)


def rolled(flat, degrees, radius):
    """A sheet in the plane of x and y, rolled to that radius in a direction at an angle to x."""
    along = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees)), 0])
    u, v = flat @ along, flat @ np.array([-along[1], along[0], 0])
    return np.stack([radius * np.sin(u / radius), v, radius * (1 - np.cos(u / radius))], axis=1)


def lattice(n, slant, height):
    """A sheet of n x n vertices, rows of which are `slant` to the side of each other and `height` apart, and its triangles."""
    i, j = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    flat = np.stack([i + slant * j, height * j, 0 * i], axis=-1).reshape(-1, 3)
    c = (i[:-1, :-1] * n + j[:-1, :-1]).ravel()
    return flat, np.concatenate([np.stack([c, c + n, c + 1], 1), np.stack([c + n, c + n + 1, c + 1], 1)]).astype(np.int32)


@pytest.mark.parametrize("degrees", [0, 20, 45, 90])
def test_bending_energy_of_a_cylinder(degrees):
    """Equilateral triangles rolled to radius r, in any direction, have the energy k / (2 r^2) per area."""
    n, radius, rigidity = 41, 40.0, 0.5
    flat, triangles = lattice(n, 0.5, np.sqrt(0.75))
    s = quadratic_bending.rest(flat, triangles, rigidity)
    area = np.sqrt(0.75) * (n - 1) ** 2
    assert energy(rolled(flat, degrees, radius), s) == pytest.approx(0.5 * rigidity * area / radius**2, rel=0.05)


@pytest.mark.parametrize("degrees", [0, 20, 45, 70, 90, 135])
@pytest.mark.parametrize(("slant", "height"), [(0.0, 1.0), (0.5, np.sqrt(0.75)), (0.3, 0.5)])
def test_bending_energy_of_a_woven_cylinder(degrees, slant, height):
    """Rolled at an angle t to the warp, here 25 degrees from x: (sqrt(k1) cos^2 t + sqrt(k2) sin^2 t)^2 / (2 r^2) per area, whatever the
    triangles. The two outer rows of each side are left out: there nothing tells what lies beyond."""
    n, radius, k1, k2 = 31, 400.0, 0.8, 0.05
    flat, triangles = lattice(n, slant, height)
    warp = np.radians(25.0)
    s = woven_bending.rest(flat, triangles, k1, k2, (np.cos(warp), np.sin(warp), 0.0))
    x = rolled(flat, degrees, radius)
    row = np.einsum("erc,ecd->erd", s.gradient, x[s.vertices])
    number = s.vertices[:, :3]
    inner = ((number % n > 1) & (number % n < n - 2) & (number // n > 1) & (number // n < n - 2)).all(axis=1)
    found = 0.5 * (s.weight * (row**2).sum(axis=(1, 2)))[inner].sum() / (height * 0.5 * inner.sum() / 3)
    t = np.radians(degrees) - warp
    expected = (np.sqrt(k1) * np.cos(t) ** 2 + np.sqrt(k2) * np.sin(t) ** 2) ** 2
    assert found == pytest.approx(0.5 * expected / radius**2, rel=1e-3)


def test_woven_bending_does_not_depend_on_how_triangles_are_turned():
    """Corners in another order, or the other way round, and a sheet sewn from triangles that are flat each by itself: one matrix."""
    rng = np.random.default_rng(12)
    x, triangles = sheet(rng)
    x[:, :2] += 0.2 * rng.standard_normal((len(x), 2))
    law = (3.0, 0.5, (1.0, 0.4, 0.0))
    expected = constraints.stiffness_matrix(len(x), [woven_bending.rest(x, triangles, *law)]).toarray()
    turned = np.stack([np.roll(t, k)[:: 1 if k % 2 else -1] for k, t in enumerate(triangles)])
    moved = x[turned] + rng.standard_normal((len(turned), 1, 3)) * [1, 1, 0]
    for s in (woven_bending.rest(x, turned, *law), woven_bending.rest(x, turned, *law, moved)):
        np.testing.assert_allclose(constraints.stiffness_matrix(len(x), [s]).toarray(), expected, atol=1e-10)


@pytest.mark.parametrize(("across", "stiffer"), [(1.0, 1.06), (1 / 3, 1.035), (3.0, 1.12), (10.0, 1.25)])
def test_a_strip_of_irregular_triangles_is_nearly_as_stiff_as_it_must_be(across, stiffer):
    """A cantilever under its weight, for small deflections, whose warp runs along it: w L^4 / 8 k, within what docs/materials.md says.

    A grid whose vertices are moved by a quarter of a cell; `across`: stiffness along the weft where that along the warp is 1.
    """
    width, cells = 0.3, 12
    step, rng = width / cells, np.random.default_rng(1)
    i, j = np.meshgrid(np.arange(40 + 1), np.arange(cells + 1), indexing="ij")
    x = np.stack([step * i, step * j, 0.0 * i], axis=-1).reshape(-1, 3)
    inner = ((i > 0) & (i < 40) & (j > 0) & (j < cells)).ravel()
    x[inner, :2] += 0.25 * step * rng.uniform(-1, 1, (inner.sum(), 2))
    triangles = Delaunay(x[:, :2]).simplices.astype(np.int32)
    sides = x[triangles[:, 1:]] - x[triangles[:, :1]]
    area = 0.5 * np.abs(np.cross(sides[:, 0], sides[:, 1])[:, 2])
    triangles, area = triangles[area > 1e-3 * step**2], area[area > 1e-3 * step**2]
    matrix = constraints.stiffness_matrix(len(x), [woven_bending.rest(x, triangles, 1.0, across, (1, 0, 0))])
    free = i.ravel() > 1  # clamped half a cell behind the last held row
    load = material.lumped_mass(len(x), triangles, area)
    sag = np.zeros(len(x))
    sag[free] = spsolve(matrix[free][:, free].tocsc(), load[free])
    expected = (40 * step - 0.5 * step) ** 4 / 8
    assert 0.98 < expected / sag[i.ravel() == 40].mean() < stiffer


def test_bad_rest_shapes_are_refused_by_name():
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    with pytest.raises(ValueError, match=r"tet 0 .* has the volume -0\.16"):
        tet_strain.rest(x, np.array([[0, 2, 1, 3]]), 1.0)
    with pytest.raises(ValueError, match=r"triangle 0 .* has the area 0"):
        triangle_strain.rest(x, np.array([[0, 1, 1]]), 1.0)
    with pytest.raises(ValueError, match="weight is nan"):
        tet_strain.rest(x, np.array([[0, 1, 2, 3]]), np.nan)
