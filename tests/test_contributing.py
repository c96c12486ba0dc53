"""The ways of CONTRIBUTING.md, walked: what it says is to be touched is all that a new thing needs."""

import dataclasses
import sys
import types
from pathlib import Path

import numpy as np
import typer
from typer.testing import CliRunner

import pdipc
from pdipc import constraints, work
from pdipc.bodies import cloth
from pdipc.cli import app
from pdipc.cli.app import ORDER, command
from pdipc.constraints import edge_length, projector
from pdipc.linear import solvers
from pdipc.linear.direct import Direct
from pdipc.nonlinear.local_global import LocalGlobal
from pdipc.scene import files, meshes
from pdipc.scene.files.contents import Contents
from tests.physics.scenes import floor, scene, solid


def block(**simulation):
    return scene([solid("block", (0.1, 0.1, 0.1), (1, 1, 1), at=(0, 0.2, 0))], [floor()], **simulation)


def test_a_constraint_kind(monkeypatch):
    """A module with its names and an entry in KINDS; a body's part of the model uses it."""
    names = {name: getattr(edge_length, name) for name in ("CORNERS", "PROJECTIVE", "arguments", "kernels")}
    mine = types.SimpleNamespace(NAME="mine", **names)
    monkeypatch.setattr(projector, "KINDS", (*constraints.KINDS, mine))
    elasticity = cloth.elasticity

    def with_mine(assembly, body, newton):
        sets, mass = elasticity(assembly, body, newton)
        return [dataclasses.replace(s, kind="mine") if s.kind == "edge_length" else s for s in sets], mass

    monkeypatch.setattr(cloth, "elasticity", with_mine)
    sheet = {"name": "sheet", "kind": "cloth", "mesh": {"shape": "grid", "cells": [2, 2]}, "material": {"membrane": "springs"}}
    model = pdipc.build(pdipc.Scene(bodies=[sheet]), "cpu")
    assert "mine" in [s.kind for s in model.projector.sets]
    assert pdipc.step(model, model.initial_state()).converged


def test_a_nonlinear_solver_and_with_it_a_contact_mode(monkeypatch):
    """A `Method` and an entry in METHODS; the settings name it."""
    frozen = []

    class Mine(LocalGlobal):
        def freeze(self):
            frozen.append(1)
            super().freeze()

    monkeypatch.setitem(work.METHODS, "mine", Mine)
    model = pdipc.build(block(nonlinear_solver="local-global"), "cpu")
    model = dataclasses.replace(model, settings=dataclasses.replace(model.settings, nonlinear_solver="mine"))
    result = pdipc.step(model, model.initial_state())
    assert frozen and np.isfinite(result.state.positions.numpy()).all()


def test_a_linear_solver(monkeypatch):
    """A `Solver` and an entry in SOLVERS."""

    class Mine(Direct):
        pass

    monkeypatch.setitem(solvers.SOLVERS, "mine", Mine)
    monkeypatch.setitem(solvers.SOLVERS, "two-level", Mine)  # which is what "auto" takes here
    assert isinstance(pdipc.build(block(nonlinear_solver="local-global"), "cpu").solver, Mine)
    assert isinstance(
        solvers.make_solver("mine", pdipc.build(block(nonlinear_solver="local-global"), "cpu").solver.system), Mine
    )


def test_a_mesh_format(monkeypatch, tmp_path):
    """A reader, an entry in READERS, and the ending."""

    def corners(path):
        points = np.loadtxt(path)
        return Contents(points, [("triangle", np.arange(len(points)).reshape(-1, 3))])

    monkeypatch.setitem(files.READERS, ".corners", corners)
    monkeypatch.setattr(meshes, "SUFFIXES", (*meshes.SUFFIXES, ".corners"))
    (tmp_path / "sheet.corners").write_text("0 0 0\n1 0 0\n0 0 1\n")
    sheet = {"name": "sheet", "kind": "cloth", "mesh": str(tmp_path / "sheet.corners")}
    assert pdipc.build(pdipc.Scene(bodies=[sheet]), "cpu").vertex_count == 3


def test_a_command(monkeypatch):
    """A function with @command(), and its place in ORDER."""
    monkeypatch.setattr(app, "registered_commands", list(app.registered_commands))
    monkeypatch.setattr(sys.modules["pdipc.cli.app"], "ORDER", (*ORDER, "mine"))

    @command()
    def mine() -> None:
        """Says so."""
        typer.echo("mine")

    runner = CliRunner()
    assert runner.invoke(app, ["mine"]).stdout == "mine\n"
    assert "Says so." in runner.invoke(app, ["--help"]).stdout


def test_every_way_is_there():
    text = (Path(__file__).parents[1] / "CONTRIBUTING.md").read_text()
    for what in ("constraint kind", "material", "contact mode", "nonlinear solver", "linear solver", "mesh format", "command"):
        assert f"| {what} |" in text
