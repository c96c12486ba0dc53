"""Meshes from elsewhere, of the optional test data: good ones pass, each imperfect one is refused for its own fault."""

import data
import numpy as np
import pytest

from pdipc.judge.witness import find_intersections
from pdipc.scene.check import check
from pdipc.scene.schema import Cloth, Scene, Solid


@pytest.mark.parametrize(
    "name",
    [
        "tet/armadillo_9k",
        "tet/bar_2523",
        "tet/bunny_19k",
        "tet/mat20x20_2k",
        "tri/dragon_1k5",
        "tri/knot_5k8",
        "cloth/skirt_16k",
    ],
)
def test_good_meshes_pass(name):
    kind = Solid if name.startswith("tet") else Cloth
    assert check(Scene(bodies=[kind(name="m", mesh=str(data.path(f"meshes/{name}.npz")))])) == []


@pytest.mark.parametrize(
    ("name", "faults"),
    [
        ("cloth/mannequin_25k", ["must not pass through itself"]),
        ("imperfect/dragon_selfx_20k", ["must not pass through itself"]),
        (
            "imperfect/dragon_nonmanifold_44k",
            [
                "11 triangles are there more than once",
                "22 edges of its surface belong to more",
                "1 vertices of its surface join fans of triangles that share no edge there: vertex ",
            ],
        ),
        ("cloth/tiered_skirt_55k_clean", ["9 vertices of its surface join fans of triangles", "m joins 2, ...; the surface"]),
    ],
)
def test_imperfect_meshes_are_refused_for_their_fault(name, faults):
    found = "\n".join(map(str, check(Scene(bodies=[Cloth(name="m", mesh=str(data.path(f"meshes/{name}.npz")))]))))
    assert [fault in found for fault in faults] == [True] * len(faults), found


@pytest.mark.parametrize(
    ("name", "frame"),
    [
        ("rod-twist", "V0"),
        ("thick-cloth", "V0"),
        ("thick-cloth", "V1"),
        ("two-cubes-close", "V"),
        ("two-cubes-intersecting", "V"),
    ],
)
def test_the_witness_agrees_with_ipctk_on_frames_of_simulations(name, frame):
    ipctk = pytest.importorskip("ipctk", reason="the independent library is not installed")
    frames = np.load(data.path(f"ccd_frames/{name}.npz"))
    positions, triangles = frames[frame], frames["F"]
    mesh = ipctk.CollisionMesh(positions, ipctk.edges(triangles), triangles)
    assert (len(find_intersections(positions, triangles)) > 0) == ipctk.has_intersections(mesh, positions)
