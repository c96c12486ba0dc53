"""`check-scene` tells where the activation distance is small beside a step, or large beside a body."""

import pytest
from typer.testing import CliRunner

import pdipc
from pdipc import model
from pdipc.cli import app
from pdipc.scene.assembly import assemble
from pdipc.scene.reach import hints, unresolved

CLOTH = {"name": "cloth", "kind": "cloth", "mesh": {"shape": "grid", "cells": [4, 4]}, "translation": [0, 0.5, 0]}
BALL = {"name": "ball", "mesh": {"shape": "sphere", "radius": 0.2}}


def of(activation=1e-3, velocity=(0, 0, 0), motion=None, step=0.01):
    ball = {**BALL, **({} if motion is None else {"motion": motion})}
    scene = pdipc.Scene(
        simulation={"time_step": step, "steps": 20},
        contact={"activation_distance": activation},
        bodies=[{**CLOTH, "velocity": list(velocity)}],
        obstacles=[ball],
    )
    return hints(scene, assemble(scene))


def test_nothing_is_said_of_a_usual_scene():
    assert of() == []
    assert of(velocity=(0, -9.9, 0)) == []


@pytest.mark.parametrize("step", [1e-3, 1e-2, 1e-1])
def test_a_fast_body_is_named_with_its_step(step):
    (line,) = of(velocity=(0, -11 * 0.1 / step * 1.0, 0), activation=1e-2, step=step)
    assert '"cloth"' in line and "110 times" in line


def test_a_fast_obstacle_is_named():
    (line,) = of(motion={"velocity": [0, -12, 0]})
    assert '"ball"' in line and "12 m/s" in line
    (line,) = of(motion={"angular_velocity": [0, 100, 0]})  # the fastest vertex: 20 m/s, on chords somewhat less
    assert '"ball"' in line


def test_an_activation_distance_that_is_large_beside_a_body():
    (line,) = of(activation=0.1)
    assert "7 % of the size" in line  # of a diagonal of sqrt(2) m


def test_a_solid_that_is_too_stiff_for_float32():
    """Steel of 1 cm elements: sound crosses 51 m in 1/100 s, 5,100 elements; of half that size, twice as many. Who runs it is warned, too."""

    def made(size, precision, **simulation):
        block = {"name": "block", "kind": "solid", "mesh": {"shape": "box", "size": [2 * size] * 3, "cells": [2, 2, 2]}}
        block["material"] = {"young_modulus": 2.1e11, "density": 8000.0}
        return pdipc.Scene(simulation={"precision": precision, **simulation}, bodies=[block])

    def told(*given, **simulation):
        scene = made(*given, **simulation)
        return [line for line in hints(scene, assemble(scene)) if "sound" in line]

    assert told(1e-2, "float32") == []
    (line,) = told(5e-3, "float32")
    assert '"block"' in line and "10247 elements" in line
    assert told(5e-3, "float64") == []
    assert told(5e-3, "float32", substeps=2) == []
    with pytest.warns(pdipc.SceneWarning, match='"block" in a step'):
        pdipc.Simulation(made(5e-3, "float32"), "cpu")
    too_stiff = unresolved(made(5e-3, "auto"), assemble(made(5e-3, "auto")))
    assert model._precision("auto", True, too_stiff) == "float64"
    assert model._precision("auto", True, []) == "float32"


def test_a_pressure_that_no_cloth_like_it_holds():
    """A ball of 0.1 m and 100 N/m holds 500 Pa, as measured: at 1.0 times that it rests, at 1.1 times it grows without end."""

    def told(pressure, **material):
        cloth = {"membrane_stiffness": 100.0, "poisson_ratio": 0.0, **material}
        ball = {"name": "ball", "kind": "cloth", "mesh": {"shape": "sphere", "radius": 0.1}, "material": cloth}
        scene = pdipc.Scene(bodies=[{**ball, "inside": {"pressure": pressure}}])
        return [line for line in hints(scene, assemble(scene)) if "without end" in line]

    assert told(495.0) == [] and told(600.0, poisson_ratio=0.3) == []
    assert told(2000.0, strain_limit=0.1) == [] and told(-2000.0) == []
    (line,) = told(510.0)
    assert "a pressure of 510 Pa" in line and '"ball"' in line and "holds 502 Pa" in line
    with pytest.warns(pdipc.SceneWarning, match="without end"):
        ball = {"name": "ball", "kind": "cloth", "mesh": {"shape": "sphere", "radius": 0.1}, "inside": {"pressure": 5e3}}
        pdipc.Simulation(pdipc.Scene(bodies=[ball]), "cpu")


def test_check_scene_prints_it(tmp_path):
    scene = tmp_path / "fast.toml"
    scene.write_text(
        'bodies = [{ name = "cloth", kind = "cloth", mesh = { shape = "grid", cells = [4, 4] }, velocity = [0.0, -20.0, 0.0] }]\n'
    )
    result = CliRunner().invoke(app, ["check-scene", str(scene)])
    assert result.exit_code == 0
    assert "20 m/s" in result.output.replace("\n", " ")
