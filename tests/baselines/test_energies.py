"""Derivatives of the baselines' energies against finite differences; projections against brute force."""

import numpy as np
import pytest

from pdipc.baselines import energies

RNG = np.random.default_rng(7)
REST = RNG.standard_normal((4, 3))
TET = np.array([[0, 1, 2, 3]]) if np.linalg.det(REST[1:] - REST[0]) > 0 else np.array([[0, 2, 1, 3]])
TRIANGLES = np.array([[0, 1, 2], [1, 0, 3]])
SINGLE = TRIANGLES[:1]

TERMS = {
    "tet strain": energies.tet_strain(REST, TET, 2.0),
    "tet volume": energies.tet_volume(REST, TET, 3.0),
    "triangle strain": energies.triangle_strain(REST, SINGLE, 2.0),
    "triangle area": energies.triangle_area(REST, SINGLE, 1.5),
    "spring": energies.springs(np.array([[0, 1]]), np.array([0.7]), 5.0),
    "attachment": energies.attachment(np.array([2]), np.array([[0.1, 0.2, 0.3]]), 4.0),
    "flat bending": energies.bending(REST, TRIANGLES, 2.0),
    "curved bending": energies.bending(REST, TRIANGLES, 2.0, curved=True),
}


def finite_differences(f, x, step=1e-6):
    result = []
    for i in np.ndindex(x.shape):
        e = np.zeros_like(x)
        e[i] = step
        result.append((f(x + e) - f(x - e)) / (2 * step))
    return np.stack(result, axis=-1)


def dense(term, x, psd):
    """Gradient and Hessian over all 12 degrees of freedom."""
    g, h = term.derivatives(x, psd=psd)
    gradient, hessian = np.zeros(12), np.zeros((12, 12))
    for k, stencil in enumerate(term.vertices):
        dofs = (3 * stencil[:, None] + np.arange(3)).ravel()
        gradient[dofs] += g[k].ravel()
        hessian[np.ix_(dofs, dofs)] += h[k].reshape(len(dofs), -1)
    return gradient, hessian


@pytest.mark.parametrize("name", TERMS)
@pytest.mark.parametrize("size", [0.2, 1.5])
def test_derivatives(name, size):
    term = TERMS[name]
    x = REST + size * np.random.default_rng(3).standard_normal(REST.shape)
    gradient, hessian = dense(term, x, psd=False)
    np.testing.assert_allclose(gradient, finite_differences(term.energy, x), atol=1e-6 * max(1, np.abs(gradient).max()))
    numeric = finite_differences(lambda y: dense(term, y, False)[0], x)
    np.testing.assert_allclose(hessian, numeric, atol=1e-5 * np.abs(hessian).max())
    projected = dense(term, x, psd=True)[1]
    assert np.linalg.eigvalsh(projected).min() > -1e-9 * np.abs(projected).max()


@pytest.mark.parametrize("name", ["tet strain", "tet volume", "triangle strain", "triangle area", "curved bending"])
def test_zero_at_rest(name):
    assert TERMS[name].energy(REST) < 1e-20


@pytest.mark.parametrize("shape", [(3, 3), (3, 2)])
def test_unit_product_is_the_nearest(shape):
    """Against a fine search of the surface p_1 p_2 (p_3) = 1."""
    for s in (np.array([2.0, 1.1, -0.4]), np.array([9.0, 8.0, 7.0]), np.array([0.3, 0.2, 0.1])):
        s = s[: shape[1]]
        p = energies._unit_product(s[None])[0][0]
        assert np.prod(p) == pytest.approx(1.0, rel=1e-9)
        grid = np.exp(np.linspace(-6, 3, 901))
        if shape[1] == 3:
            a, b = np.meshgrid(grid, grid)
            found = (a - s[0]) ** 2 + (b - s[1]) ** 2 + (1 / (a * b) - s[2]) ** 2
        else:
            found = (grid - s[0]) ** 2 + (1 / grid - s[1]) ** 2
        assert ((p - s) ** 2).sum() <= found.min() + 1e-9
