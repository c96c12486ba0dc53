"""Mesh files taken apart: points and cells of every kind as they are written, and what was left out.

`pdipc.scene.meshes` makes triangles and tetrahedra of them. Formats that other packages parse are read in a process of their own,
see `pdipc.scene.worker`.
"""

from collections.abc import Callable
from pathlib import Path

from pdipc.scene.files import alembic, foreign, surfaces, volumes, vtk
from pdipc.scene.files.contents import Contents

READERS = {
    ".msh": volumes.msh, ".mesh": volumes.medit, ".node": volumes.tetgen, ".ele": volumes.tetgen,
    ".vtk": vtk.legacy, ".vtu": vtk.xml, ".vtp": vtk.xml, ".glb": foreign.glb,
    ".usd": foreign.usd, ".usda": foreign.usd, ".usdc": foreign.usd, ".usdz": foreign.usd, ".abc": alembic.archive,
    ".obj": surfaces.obj, ".ply": surfaces.ply, ".stl": surfaces.stl, ".off": surfaces.off, ".npz": surfaces.npz,
}  # fmt: skip


def parse(path: Path, frames: bool = False, prim: str | None = None) -> Contents:
    """The contents of a file of a known format. Raises whatever its reader does; SceneError where its message is whole.

    Of a USD stage or an Alembic archive: frames: whether all frames are wanted, which takes time; prim: path of the prim or object below which
    meshes are taken, None: all.
    """
    own = reader(path)
    return own(path, frames, prim) if own in (foreign.usd, alembic.archive) else own(path)


def reader(path: Path) -> Callable[..., Contents]:
    """The function that reads a file: meshio reads a .msh that is not of Gmsh or of an old version, and the regular grids of a .vtk."""
    own = READERS[path.suffix.lower()]
    known = {volumes.msh: volumes.is_known, vtk.legacy: vtk.is_known}.get(own)
    return own if known is None or known(path) else foreign.by_meshio


def is_foreign(path: Path) -> bool:
    """Whether another package parses this file."""
    return reader(path) in (foreign.by_meshio, foreign.glb, foreign.usd, alembic.archive)
