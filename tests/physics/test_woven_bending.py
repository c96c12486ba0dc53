"""Cloth that is stiffer to bend one way: strips that hang over an edge, against the heavy elastica, in a scene with contact."""

import numpy as np
import pytest
from scipy.integrate import solve_bvp

import pdipc
from physics.scenes import cloth, floor, scene, watched

DENSITY, GRAVITY, WIDTH = 0.2, 9.81, 0.02  # kg/m^2, m/s^2, m
WARP, WEFT = 1.2e-4, 1.5e-5  # N m
PEIRCE = np.radians(41.5)  # where half of the overhang is the bending length (B / w)^(1/3), Peirce 1930


def bending_length(rigidity):
    return (rigidity / (DENSITY * GRAVITY)) ** (1 / 3)


def elastica(rigidity, length):
    """Horizontal reach and drop, m, of the end of a clamped strip under its weight: B t'' = -w (l - s) cos t."""
    load = DENSITY * GRAVITY / rigidity

    def change(s, y):
        return [y[1], -load * (length - s) * np.cos(y[0]), np.cos(y[0]), -np.sin(y[0])]

    s = np.linspace(0, length, 200)
    found = solve_bvp(change, lambda a, b: [a[0], b[1], a[2], a[3]], s, np.zeros((4, 200)), tol=1e-9, max_nodes=20000)
    assert found.success
    return found.y[2, -1], -found.y[3, -1]


def hanging(length, material, cells=12, **simulation):
    """A strip that is held up to half a cell beyond an edge, 0.3 m above a floor, and hangs over it by `length`."""
    step = length / (cells - 0.5)
    strip = cloth("strip", (cells * step, WIDTH), (cells, 5), at=(0.5 * cells * step - 0.5 * step, 0.3, 0))
    strip["pins"] = [{"select": {"box": [[-1, 0, -1], [0.51 * step, 1, 1]]}}]
    strip["material"] = {"areal_density": DENSITY, "membrane_stiffness": 300.0, **material}
    contact = {"activation_distance": 1e-3}
    return watched(scene([strip], [floor(1.0)], contact=contact, **simulation))


@pytest.mark.parametrize(("warp", "rigidity"), [((1, 0, 0), WARP), ((0, 0, 1), WEFT)])
def test_strips_along_warp_and_weft_hang_as_far_as_they_must(warp, rigidity):
    """Both twice as long as they bend: each end lies 41.5 degrees below the edge, as Peirce's test of cloth has it, and where the elastica ends."""
    length = 2 * bending_length(rigidity)
    material = {"bending_stiffness": WARP, "weft_bending_stiffness": WEFT, "warp": warp}
    simulation = hanging(length, material, time_step=0.2, damping=2.0, tolerance=1e-6)
    for _ in range(12):
        assert simulation.step().converged
    assert np.abs(simulation.velocities).max() < 1e-4
    x = simulation.positions[: simulation.model.assembly.bodies[0].last]
    reach, height = x[x[:, 0] > x[:, 0].max() - 1e-3].mean(axis=0)[:2]
    expected = elastica(rigidity, length)
    assert np.arctan2(expected[1], expected[0]) == pytest.approx(PEIRCE, rel=2e-3)
    assert (reach, 0.3 - height) == pytest.approx(expected, rel=0.01)


def test_both_solvers_bend_it_alike():
    """It is a projective constraint, so that local-global iterations, and the paper's, have it, too."""
    found = []
    for solver in ("newton", "local-global"):
        material = {"bending_stiffness": WARP, "weft_bending_stiffness": WEFT, "warp": (1, 0, 1), "membrane_stiffness": 30.0}
        exact = {"time_step": 0.01, "tolerance": 1e-6, "max_outer": 500}
        exact |= {"linear_iterations": 100} if solver == "local-global" else {}
        simulation = hanging(0.06, material, nonlinear_solver=solver, **exact)
        for _ in range(5):
            assert simulation.step().converged
        found.append(simulation.positions)
    assert found[0][:84, 1].min() < 0.3 - 0.005  # bent far beyond what is compared
    np.testing.assert_allclose(*found, atol=2e-6)


def test_cloth_that_bends_alike_has_hinges_as_before():
    plain = {"bending_stiffness": WARP}
    kinds = {s.kind for s in pdipc.build(scene([cloth("sheet", (0.1, 0.1), (2, 2), material=plain)]), "cpu").projector.sets}
    assert "quadratic_bending" in kinds and "woven_bending" not in kinds


@pytest.mark.parametrize(
    ("material", "message"),
    [
        (
            {"weft_bending_stiffness": 1e-5, "bending_stiffness": 0.0},
            "weft_bending_stiffness needs a bending_stiffness above 0",
        ),
        ({"weft_bending_stiffness": 1e-5, "bending": "curved"}, 'weft_bending_stiffness has no effect on bending = "curved"'),
        ({"weft_bending_stiffness": 0.0}, "weft_bending_stiffness"),
        ({"warp": (1, 0, 0)}, "warp must be a direction, and needs weft_stiffness, shear_stiffness or weft_bending_stiffness"),
    ],
)
def test_what_does_not_go_together_is_refused(material, message):
    with pytest.raises(pdipc.SceneError, match=message):
        scene([cloth("sheet", (0.1, 0.1), (2, 2), material=material)])


def test_a_warp_across_triangles_is_refused():
    material = {"weft_bending_stiffness": 1e-5, "warp": (0, 1, 0)}
    (found,) = pdipc.check_scene(scene([cloth("sheet", (0.1, 0.1), (2, 2), material=material)]))
    assert str(found).startswith('body "sheet": material.warp: [0.0, 1.0, 0.0] is across 8 of 8 triangles')
