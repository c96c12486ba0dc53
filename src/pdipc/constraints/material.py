"""Engineering values to weights: the one place where Pa and N/m become the w of Eq. (2).

Solids. For small strains e, w V |F - R|^2 / 2 is w V e:e / 2, and w V |F - P|^2 / 2 with det P = 1 is w V tr(e)^2 / 6. Hooke's
law has the energy V (mu e:e + lambda tr(e)^2 / 2). So tet_strain has w = 2 mu and tet_volume has w = 3 lambda.

Cloth, in plane stress with Y = E t in N/m: triangle_strain has w = 2 mu', mu' = Y / (2 (1 + nu)), and triangle_area, where
|F - P|^2 is tr(e)^2 / 2, has w = 2 lambda', lambda' = Y nu / (1 - nu^2). An area stiffness K of its own, K tr(e)^2 / 2, adds 2 K.
"""

import numpy as np

from pdipc.constraints import triangles as _triangles


def solid(young_modulus: float, poisson_ratio: float) -> tuple[float, float]:
    """Weights per volume, Pa, of tet_strain and tet_volume. young_modulus: Pa. poisson_ratio: 0 up to less than 0.5."""
    mu = young_modulus / (2.0 * (1.0 + poisson_ratio))
    lame = young_modulus * poisson_ratio / ((1.0 + poisson_ratio) * (1.0 - 2.0 * poisson_ratio))
    return 2.0 * mu, 3.0 * lame


def cloth(membrane_stiffness: float, poisson_ratio: float) -> tuple[float, float]:
    """Weights per area, N/m, of triangle_strain and triangle_area. membrane_stiffness: Y = E t, N/m."""
    mu = membrane_stiffness / (2.0 * (1.0 + poisson_ratio))
    lame = membrane_stiffness * poisson_ratio / (1.0 - poisson_ratio**2)
    return 2.0 * mu, 2.0 * lame


def woven(warp: float, weft: float, shear: float | None, poisson_ratio: float) -> tuple[float, float, float, float]:
    """C11, C22, C12 and S of `constraints.woven`, N/m: plane stress with nu_12 nu_21 = nu^2 and nu_12 / warp = nu_21 / weft, so that cloth
    pulled along its warp (weft) is as stiff as that. shear: N/m; None for sqrt(warp weft) / (2 (1 + nu)).
    """
    mean, free = float(np.sqrt(warp * weft)), 1.0 - poisson_ratio**2
    return warp / free, weft / free, poisson_ratio * mean / free, shear or mean / (2.0 * (1.0 + poisson_ratio))


def springs(rest_positions: np.ndarray, triangles: np.ndarray, membrane_stiffness: float) -> tuple[np.ndarray, np.ndarray]:
    """Edges (e, 2) of a sheet and their spring constants (e,), N/m, that stretch about as a membrane of Y (Van Gelder 1998).

    An edge of length l with triangles of area A around it gets Y A / l^2.
    """
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    area = np.repeat(_triangles.rest_shape(rest_positions, triangles)[1], 3)
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    around = np.bincount(inverse.ravel(), weights=area, minlength=len(unique))
    length = np.linalg.norm(rest_positions[unique[:, 1]] - rest_positions[unique[:, 0]], axis=1)
    return unique.astype(np.int32), membrane_stiffness * around / length**2


def lumped_mass(count: int, elements: np.ndarray, element_mass: np.ndarray) -> np.ndarray:
    """(count,) kg: each element's mass, (e,), in equal parts at its vertices (e, c)."""
    corners = elements.shape[1]
    return np.bincount(elements.ravel(), weights=np.repeat(element_mass / corners, corners), minlength=count)
