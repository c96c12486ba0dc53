"""Garments: cloth cut from flat panels, woven cloth, and the limit of its stretch."""

import numpy as np
import pytest

import pdipc
from pdipc.constraints import quadratic_bending
from pdipc.scene.assembly import assemble
from pdipc.scene.check_garments import stretches
from physics.scenes import cloth, scene, watched

STRIP = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0, 0, 0.1], [0.1, 0, 0.1], [0.2, 0, 0.1]])
FACES = np.array([[0, 3, 1], [1, 3, 4], [1, 4, 2], [2, 4, 5]])


def strip(material, pull, rest=None, steps=6, points=STRIP, **more):
    """A strip of 0.2 m x 0.1 m, held at x = 0 along x only by symmetry, pulled evenly at both ends with `pull` N/m; its static shape."""
    body = {"name": "strip", "kind": "cloth", "mesh": {"vertices": points, "triangles": FACES}, **more}
    body["material"] = {"bending_stiffness": 0.0, **material}
    if rest is not None:
        body["rest"] = rest
    simulation = watched(scene([body], gravity=(0, 0, 0), time_step=1.0, tolerance=1e-8))
    force = 0.5 * pull * 0.1 * np.array([[-1, 0, 0], [0, 0, 0], [1, 0, 0]] * 2)
    simulation.set_vertex_force(np.arange(6), force)
    for _ in range(steps):
        result = simulation.step()
        assert result.converged
    return simulation


def stretch_of(simulation):
    """Of the whole strip along its length and its width."""
    x = simulation.positions
    return np.linalg.norm(x[[2, 5]] - x[[0, 3]], axis=1).mean() / 0.2, np.linalg.norm(x[3:] - x[:3], axis=1).mean() / 0.1


# --- woven cloth


@pytest.mark.parametrize(("direction", "stiffness"), [((1, 0, 0), 200.0), ((0, 0, 1), 50.0)])
def test_woven_cloth_is_as_stiff_as_it_is_said_to_be(direction, stiffness):
    """Pulled along its warp, then along its weft: e = F / Y, and across -nu_12 e with nu_12 = nu sqrt(Y1 / Y2)."""
    material = {"membrane_stiffness": 200.0, "weft_stiffness": 50.0, "poisson_ratio": 0.2, "warp": direction}
    along, across = stretch_of(strip(material, 0.5))
    assert along - 1 == pytest.approx(0.5 / stiffness, rel=0.02)
    assert across - 1 == pytest.approx(-0.2 * np.sqrt(stiffness / (10000.0 / stiffness)) * 0.5 / stiffness, rel=0.03)


def test_woven_cloth_at_an_angle():
    """Pulled at 45 degrees: 1/Y = (1/Y1 + 1/Y2 + 1/S - 2 nu_12 / Y1) / 4; soft shear makes it the softest direction."""
    y1, y2, shear, nu = 200.0, 50.0, 4.0, 0.2
    material = {
        "membrane_stiffness": y1,
        "weft_stiffness": y2,
        "shear_stiffness": shear,
        "poisson_ratio": nu,
        "warp": (1, 0, 1),
    }
    x = strip(material, 0.02).positions
    f = np.stack([(x[1] - x[0]) / 0.1, (x[3] - x[0]) / 0.1], axis=1)
    strain = 0.5 * (f.T @ f - np.eye(2))
    expected = (1 / y1 + 1 / y2 + 1 / shear - 2 * nu * np.sqrt(y1 / y2) / y1) / 4
    assert strain[0, 0] == pytest.approx(0.02 * expected, rel=0.03)


def test_woven_cloth_of_one_stiffness_is_isotropic_for_small_strains():
    isotropic = {"membrane_stiffness": 100.0, "poisson_ratio": 0.3}
    plain, woven = (stretch_of(strip(m, 0.1)) for m in (isotropic, {**isotropic, "weft_stiffness": 100.0}))
    assert np.subtract(woven, 1) == pytest.approx(np.subtract(plain, 1), rel=2e-2)


# --- the limit of stretch


@pytest.mark.parametrize("limit", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("pull", [1.0, 30.0, 300.0])
def test_the_limit_of_stretch_holds(limit, pull):
    """Against pulls that would stretch the membrane of 20 N/m by 5 % up to fifteenfold: never by more than the limit and 1 % of it."""
    simulation = strip({"membrane_stiffness": 20.0, "poisson_ratio": 0.0, "strain_limit": limit}, pull, steps=4)
    assembly = simulation.model.assembly
    assembly.positions = simulation.positions
    most = stretches(assembly, assembly.bodies[0])[1].max() - 1
    assert most <= 1.01 * limit
    if pull / 20.0 < 0.5 * limit:  # far from the limit it is not felt
        assert most == pytest.approx(pull / 20.0, rel=0.02)
    if pull / 20.0 > 5 * limit:  # and far beyond, cloth is stretched as far as it goes
        assert most > 0.95 * limit


def test_a_held_cloth_under_a_heavy_load_stays_within_its_limit_at_every_step():
    """A sheet held at two corners, and thrown down: 5 % of stretch, in every step and triangle."""
    pins = [{"select": {"nearest": [-0.15, 0, -0.15]}}, {"select": {"nearest": [0.15, 0, -0.15]}}]
    material = {"areal_density": 2.0, "membrane_stiffness": 50.0, "bending_stiffness": 1e-5, "strain_limit": 0.05}
    sheet = cloth("sheet", (0.3, 0.3), (4, 4), pins=pins, material=material, velocity=(0, -1.0, 0))
    simulation = watched(scene([sheet], contact={"activation_distance": 2e-3}, time_step=0.01))
    assembly, most = simulation.model.assembly, 0.0
    for _ in range(18):
        assert simulation.step().converged
        assembly.positions = simulation.positions
        most = max(most, stretches(assembly, assembly.bodies[0])[1].max() - 1)
    assert 0.04 < most <= 1.01 * 0.05


# --- cut from flat panels


def panels(points=None, scale=1.0):
    """The strip's triangles, each apart from the others, flat in the plane of x and y, turned and moved."""
    points = STRIP if points is None else points
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    flat = np.concatenate([points[face][:, [0, 2]] @ turn.T + [3.0 * k, 0.5] for k, face in enumerate(FACES)]) / scale
    return {"vertices": np.column_stack([flat, np.zeros(12)]), "triangles": np.arange(12).reshape(4, 3)}


def test_a_pattern_of_the_same_shape_changes_nothing():
    material = {"membrane_stiffness": 100.0, "poisson_ratio": 0.3, "bending_stiffness": 1e-3}
    plain, cut = (strip(material, 2.0, rest).positions for rest in (None, {"mesh": panels(scale=0.01), "scale": 0.01}))
    np.testing.assert_allclose(cut, plain, atol=1e-7)


def test_bending_of_a_pattern_is_that_of_the_flat_sheet():
    body = {"name": "strip", "kind": "cloth", "mesh": {"vertices": STRIP, "triangles": FACES}, "rest": {"mesh": panels()}}
    cut = assemble(scene([body])).bodies[0]
    whole, sewn = (quadratic_bending.rest(STRIP, FACES.astype(np.int32), 2.0, corners) for corners in (None, cut.pattern))
    np.testing.assert_allclose(sewn.gradient, whole.gradient, atol=1e-12)
    np.testing.assert_allclose(sewn.weight, whole.weight, rtol=1e-12)


def test_cloth_goes_to_the_size_of_its_pattern():
    """A strip that starts a tenth too long shrinks to its pattern, and weighs what that weighs."""
    long = STRIP * [1.1, 1.0, 1.0]
    simulation = strip({"membrane_stiffness": 100.0, "areal_density": 0.5}, 0.0, {"mesh": panels()}, points=long)
    assert stretch_of(simulation) == pytest.approx((1.0, 1.0), abs=1e-5)
    assert simulation.model.mass.numpy().sum() == pytest.approx(0.5 * 0.02)


def test_warp_lies_in_the_pattern():
    """The pattern is turned by a quarter: what is pulled along x is its second axis."""
    material = {"membrane_stiffness": 200.0, "weft_stiffness": 50.0, "poisson_ratio": 0.0}
    for warp, stiffness in (((1, 0, 0), 50.0), ((0, 1, 0), 200.0)):
        along, _ = stretch_of(strip({**material, "warp": warp}, 0.5, {"mesh": panels()}))
        assert along - 1 == pytest.approx(0.5 / stiffness, rel=0.02)


def test_texture_coordinates_are_a_pattern(tmp_path):
    flat = panels()["vertices"] / 2.0
    lines = [f"v {x} {y} {z}" for x, y, z in STRIP] + [f"vt {u} {v}" for u, v, _ in flat]
    faces = [" ".join(f"{vertex + 1}/{3 * k + c + 1}" for c, vertex in enumerate(face)) for k, face in enumerate(FACES)]
    (tmp_path / "strip.obj").write_text("\n".join([*lines, *(f"f {face}" for face in faces)]))
    body = {"name": "strip", "kind": "cloth", "mesh": str(tmp_path / "strip.obj"), "rest": {"uv": True, "scale": 2.0}}
    np.testing.assert_allclose(assemble(scene([body])).bodies[0].pattern.reshape(-1, 3), panels()["vertices"], atol=1e-12)


def strip_table(**more):
    return {"name": "strip", "kind": "cloth", "mesh": {"vertices": STRIP, "triangles": FACES}, **more}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"rest": {"mesh": {"vertices": STRIP, "triangles": FACES[:3]}}}, "rest: has 3 triangles; the cloth has 4"),
        ({"rest": {"uv": True}}, "rest: uv needs a cloth whose mesh is an .obj file"),
        ({"rest": {"mesh": panels(scale=0.001)}}, r"rest: triangles\[.*in the pattern.*must correspond one to one"),
        (
            {"rest": {"mesh": panels()}, "material": {"membrane": "springs"}},
            "takes its rest shape from the mesh, and with `rest` that is another",
        ),
        (
            {"rest": {"mesh": panels()}, "material": {"bending": "curved"}},
            "takes its rest shape from the mesh, and with `rest` that is another",
        ),
        ({"rest": {"mesh": panels(STRIP / 1.2)}, "material": {"strain_limit": 0.1}}, "starts stretched by 0.2"),
    ],
)
def test_patterns_that_do_not_fit_are_refused(more, message):
    with pytest.raises(pdipc.SceneError, match=message):
        pdipc.build(scene([strip_table(**more)]), "cpu")


def test_what_needs_newton_says_so():
    material = {"strain_limit": 0.1, "weft_stiffness": 10.0}
    found = [str(f) for f in pdipc.check_scene(scene([strip_table(material=material)], nonlinear_solver="local-global"))]
    assert len(found) == 2 and all("needs the Newton solver" in f for f in found)
    with pytest.raises(pdipc.SceneError, match="weft_stiffness has no effect on springs"):
        scene([strip_table(material={"weft_stiffness": 10.0, "membrane": "springs"})])
    with pytest.raises(pdipc.SceneError, match="warp must be a direction"):
        scene([strip_table(material={"warp": (1, 0, 0)})])


def test_a_warp_across_triangles_is_refused():
    box = {"shape": "box", "size": [0.2, 0.1, 0.2], "cells": [2, 1, 2]}
    body = {"name": "bag", "kind": "cloth", "mesh": box, "material": {"weft_stiffness": 10.0}}
    (found,) = pdipc.check_scene(scene([body]))
    assert str(found).startswith('body "bag": material.warp: [1.0, 0.0, 0.0] is across 8 of 32 triangles')
    body["material"]["warp"] = (1.0, 0.5, 0.3)
    assert pdipc.check_scene(scene([body])) == []
