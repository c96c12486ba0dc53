"""What is drawn of rods: closed tubes of their radius, in pictures and exports; and runs with rods go on to the same bits."""

import numpy as np
import pytest

import pdipc
from pdipc.export.export import export
from pdipc.output import skins
from pdipc.scene.assembly import assemble
from pdipc.scene.meshes import is_closed


def scene(**simulation):
    ring = {
        "name": "ring",
        "kind": "rod",
        "mesh": {"shape": "ring", "radius": 0.1, "segments": 24},
        "translation": (0, 0.05, 0),
    }
    rope = {"name": "rope", "kind": "rod", "mesh": {"shape": "rope", "segments": 12}, "rotation": (0, 90, 0)}
    rope["pins"] = [{"select": {"vertices": [0, 1, 12]}}]
    sheet = {
        "name": "sheet",
        "kind": "cloth",
        "mesh": {"shape": "grid", "size": (0.1, 0.1), "cells": (2, 2)},
        "translation": (0, -0.2, 0),
    }
    return pdipc.Scene(bodies=[ring, rope, sheet], simulation={"steps": 4, **simulation})


@pytest.mark.parametrize("name", ["ring", "rope"])
def test_tubes_are_closed_and_as_thick_as_the_rod(name):
    assembly = assemble(scene())
    (body,) = (body for body in assembly.bodies if body.name == name)
    tube = skins.skin(body.triangles, body.material.radius)
    points = tube.points(assembly.positions)
    assert len(points) == len(tube.sources)
    assert is_closed(tube.triangles)
    corners = points[tube.triangles]
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    length = np.linalg.norm(assembly.positions[body.segments[:, 1]] - assembly.positions[body.segments[:, 0]], axis=1).sum()
    sides = skins.SIDES
    section = 0.5 * sides * np.sin(2 * np.pi / sides) * body.material.radius**2
    assert volume == pytest.approx(section * length, rel=0.02)
    assert np.linalg.norm(points - assembly.positions[tube.sources], axis=1).max() == pytest.approx(body.material.radius)


def test_a_run_with_rods_is_exported_and_goes_on_to_the_same_bits(tmp_path):
    pdipc.run_scene(scene(), tmp_path / "run", device="cpu", certify=True)
    run = pdipc.open_run(tmp_path / "run")
    for to, name in (("obj", "obj"), ("ply", "ply"), ("vtk", "vtk"), ("usd", "run.usda")):
        export(run, to, tmp_path / name)
    text = (tmp_path / "obj" / "frame_000004.obj").read_text()
    tubes = 24 * skins.SIDES + 13 * skins.SIDES + 2
    assert text.count("v ") == len(run.topology["body_of_vertex"]) + tubes
    assert text.count("f ") == 2 * 24 * skins.SIDES + 2 * 12 * skins.SIDES + 2 * skins.SIDES + 8
    pdipc.run_scene(scene(steps=2), tmp_path / "part", device="cpu")
    pdipc.run_scene(scene(), tmp_path / "part", device="cpu", resume=True)
    assert np.array_equal(pdipc.open_run(tmp_path / "part").positions(-1), run.positions(-1))


def test_rods_that_pass_are_a_hit_for_the_certificate(tmp_path):
    """A motion that leads the rope through the ring, though both of its ends are clean; the run itself has none."""
    pytest.importorskip("ipctk", reason="needs ipctk (extra: witness)")
    from pdipc.judge.certify import certify
    from pdipc.output.results import RunWriter

    pdipc.run_scene(scene(steps=2), tmp_path / "run", device="cpu", certify=True)
    assert certify(pdipc.open_run(tmp_path / "run")).hits == []
    writer = RunWriter.resume(tmp_path / "run")
    start = pdipc.open_run(tmp_path / "run").positions(-1)
    end = start.copy()
    end[pdipc.open_run(tmp_path / "run").topology["body_of_vertex"] == 0, 1] -= 0.5
    writer.append_segments(3, 0, start, end)
    writer.append(3, 0.03, end, {})
    writer.close()
    hits = certify(pdipc.open_run(tmp_path / "run")).hits
    assert hits and all('"ring"' in hit.what and "an edge and an edge" in hit.what for hit in hits if '"rope"' in hit.what)
    assert any('"rope"' in hit.what for hit in hits)
