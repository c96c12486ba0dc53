"""What closed sheets hold: its laws, and that force and Hessian, with the part that no block holds, are derivatives of its energy."""

import numpy as np
import pytest
import warp as wp

from pdipc import constraints
from pdipc.constraints import enclosed_volume
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.linear.blocks import BlockMatrix
from pdipc.scene.garments import Inside
from pdipc.scene.generators import Sphere

EXACT, PROJECTED = (wp.array([value], dtype=wp.int32, device="cpu") for value in (0, 1))
LAWS = {
    "pressure": (3.0, 0.0, 1.0, 0.0),
    "gas": (-1.0, 1.5, 1.0, 0.0),
    "adiabatic gas": (-1.0, 1.5, 1.4, 0.0),
    "liquid": (0.0, 0.0, 1.0, 20.0),
}


def two_balls(law, threads=1, precision="float64", filled=1.1):
    """Dented balls of radius 0.5 and 0.7 that hold the same in `filled` times their volume; the second far from the origin."""
    mesh = Sphere(radius=0.5, cells=2).mesh().surface()
    x = np.concatenate([mesh.vertices, 1.4 * mesh.vertices + [50.0, 20.0, -30.0]])
    x = x + 0.03 * np.random.default_rng(0).standard_normal(x.shape)
    triangles = np.concatenate([mesh.triangles, mesh.triangles + len(mesh.vertices)]).astype(np.int32)
    cavity = enclosed_volume.cavities(triangles)
    volume = enclosed_volume.volumes(x, triangles, cavity)
    rows = np.column_stack([np.tile(law, (len(cavity), 1)), filled * volume])
    number, device = real(precision), Device("cpu", threads=threads)
    return x, constraints.Projector(device, number, len(x), [enclosed_volume.rest(triangles, cavity, rows)]), np.unique(volume)


def arrays(x, projector):
    vec3 = projector.real.vec3
    return wp.array(x, dtype=vec3, device="cpu"), wp.zeros(len(x), dtype=vec3, device="cpu")


def energy(x, projector):
    projector.evaluate(*arrays(x, projector))
    return projector.energies.numpy().sum()


def forces(x, projector):
    base, u = arrays(x, projector)
    out, none = wp.zeros_like(u), wp.zeros_like(u)
    projector.add_forces(base, u, out, none)
    return out.numpy()


def product(x, projector, p, project):
    """The Hessian times p: assembled blocks and what `Cavities` adds."""
    base, u = arrays(x, projector)
    n = len(x)
    matrix = BlockMatrix(projector.device, projector.real, projector, np.zeros(n), np.ones(n, dtype=bool))
    matrix.assemble(base, u, project)
    y = wp.zeros(n, dtype=projector.real.vec3, device="cpu")
    projector.cavities.apply(wp.array(p, dtype=projector.real.vec3, device="cpu"), y)
    offsets, columns, values = matrix.offsets.numpy(), matrix.columns.numpy()[: matrix.nnz], matrix.values.numpy()[: matrix.nnz]
    rows = np.repeat(np.arange(n), np.diff(offsets))
    found = y.numpy()
    np.add.at(found, rows, np.einsum("eij,ej->ei", values, p[columns] - p[rows]))
    return found


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_force_and_hessian_are_derivatives(law):
    """By central differences; the Hessian with both of its parts, none projected."""
    x, projector, _ = two_balls(law)
    p = np.random.default_rng(1).standard_normal(x.shape)
    step = 1e-5
    slope = (energy(x + step * p, projector) - energy(x - step * p, projector)) / (2 * step)
    assert -(forces(x, projector) * p).sum() == pytest.approx(slope, rel=1e-6)
    change = -(forces(x + step * p, projector) - forces(x - step * p, projector)) / (2 * step)
    assert np.abs(product(x, projector, p, EXACT) - change).max() < 1e-7 * np.abs(change).max()


@pytest.mark.parametrize("law", [LAWS["pressure"], LAWS["adiabatic gas"]], ids=["pressure", "adiabatic gas"])
def test_projected_hessian_is_what_is_positive(law):
    x, projector, _ = two_balls(law)
    n = 3 * len(x)
    dense = np.array([product(x, projector, row.reshape(-1, 3), PROJECTED).ravel() for row in np.eye(n)])
    values = np.linalg.eigvalsh(dense)
    assert np.abs(dense - dense.T).max() < 1e-12 * max(1.0, np.abs(dense).max())
    assert values[0] > -1e-12 * max(1.0, values[-1])
    assert (values > 1e-9).sum() == (0 if law[1] == law[3] == 0.0 else 2)  # one direction for each cavity


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_forces_leave_momentum_alone_and_are_those_of_the_volume(law):
    x, projector, volumes = two_balls(law)
    force = forces(x, projector)
    half = len(x) // 2
    for part in (slice(0, half), slice(half, None)):
        arm = x[part] - x[part].mean(axis=0)
        size = np.abs(force[part]).sum()
        assert np.abs(force[part].sum(axis=0)).max() < 1e-12 * size
        assert np.abs(np.cross(arm, force[part]).sum(axis=0)).max() < 1e-12 * size
        # growing evenly does the work q dV = 3 q V
        work = (force[part] * arm).sum()
        filled = 1.1 * volumes[0 if part.start == 0 else 1]
        volume = filled / 1.1
        q = law[0] + law[1] * (filled / volume) ** law[2] + law[3] * (1 - volume / filled)
        assert work == pytest.approx(3 * q * volume, rel=1e-9)
    assert np.allclose(projector.cavities.volume.numpy(), volumes)


def test_sums_have_the_same_bits_for_any_number_of_threads():
    found = []
    for threads in (1, 3):
        x, projector, _ = two_balls(LAWS["gas"], threads, "float32")
        found.append((energy(x, projector), forces(x, projector), product(x, projector, x, EXACT)))
    for one, other in zip(*found, strict=True):
        np.testing.assert_array_equal(one, other)


def test_filling_takes_its_time():
    assert Inside(pressure=5.0, start=1.0, rise=2.0).law(0.5, 0.1)[0] == 0.0
    assert Inside(pressure=5.0, start=1.0, rise=2.0).law(2.0, 0.1)[0] == 2.5
    for time, expected in ((0.0, 0.1), (0.5, 0.15), (3.0, 0.2)):
        assert Inside(bulk_modulus=1e5, volume=0.2, rise=1.0).law(time, 0.1)[4] == pytest.approx(expected)
    gas = Inside(gas=2e5, volume=0.2, rise=1.0)
    for time, volume, expected in ((0.0, 0.1, 0.0), (1.0, 0.2, 2e5 - 101325.0)):
        a, b, exponent, _, filled = gas.law(time, 0.1)
        assert a + b * (filled / volume) ** exponent == pytest.approx(expected, abs=1e-6)
