"""Linear finite elements on the tets of a body, in NumPy and SciPy: what small deformations are measured by."""

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla


def stiffness(x, tets, young, poisson):
    """(3n, 3n) N/m of Hooke's law on linear tets."""
    lame, mu = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    edges = np.swapaxes(x[tets[:, 1:]] - x[tets[:, :1]], 1, 2)
    volume, g = np.linalg.det(edges) / 6, np.linalg.inv(edges)
    g = np.concatenate([-g.sum(axis=1, keepdims=True), g], axis=1)  # (t, 4, 3): gradients of the shape functions
    block = lame * np.einsum("tai,tbj->tabij", g, g) + mu * np.einsum("taj,tbi->tabij", g, g)
    block += mu * np.einsum("tai,tbi->tab", g, g)[..., None, None] * np.eye(3)
    dof = (3 * tets[:, :, None] + np.arange(3)).reshape(len(tets), 12)
    values = np.swapaxes(block * volume[:, None, None, None, None], 2, 3).reshape(len(tets), 144)
    return sp.csr_matrix((values.ravel(), (np.repeat(dof, 12), np.tile(dof, 12).ravel())), shape=(x.size, x.size))


def sagging(k, mass, held):
    """Displacements (n, 3), m, under gravity along -y; k: N/m, mass: (n,) kg, held: (n,) bool."""
    load, inside = np.zeros((len(mass), 3)), np.repeat(~held, 3)
    load[:, 1] = -9.81 * mass
    u = np.zeros(load.size)
    u[inside] = spla.spsolve(k[inside][:, inside].tocsc(), load.ravel()[inside])
    return u.reshape(-1, 3)


def lowest_mode(k, mass, held):
    """rad/s of the slowest vibration, and its shape (n, 3), whose largest displacement is 1."""
    inside, shape = np.repeat(~held, 3), np.zeros(3 * len(mass))
    m = sp.diags(np.repeat(mass, 3)[inside])
    square, mode = spla.eigsh(k[inside][:, inside].tocsc(), 1, m.tocsc(), sigma=0.0)
    shape[inside] = mode[:, 0] / np.abs(mode).max()
    return float(np.sqrt(square[0])), shape.reshape(-1, 3)


def prescribed(k, u, held):
    """Displacements (n, 3) where those of the held vertices are given, and the forces (n, 3), N, that hold them."""
    inside, u = np.repeat(~held, 3), u.ravel().copy()
    u[inside] = spla.spsolve(k[inside][:, inside].tocsc(), -(k[inside][:, ~inside] @ u[~inside]))
    return u.reshape(-1, 3), (k @ u).reshape(-1, 3)
