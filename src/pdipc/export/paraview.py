"""One file for ParaView (5.13 or newer): a piece for each body, by its name, with velocity, displacement and pressure.

VTKHDF 2.2, a PartitionedDataSetCollection of UnstructuredGrids with Steps (docs.vtk.org, "VTKHDF format specification"). run.vtkhdf in
a run folder, which grows as the run does, has one grid of all bodies, and their positions alone.
"""

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pdipc.output.results import Run, RunError
from pdipc.output.vtkhdf import CELL_TYPES, cells

SUFFIX = ".vtkhdf"


def export_paraview(run: Run, path: Path) -> Path:
    """A .vtkhdf file of all frames. In each piece, at points: `velocity`, m/s, the mean since the frame before (0 in the first),
    `displacement`, m, from the first frame, and `pressure`, Pa, of contact; in cells: `body` and `material`, numbers; bodies of one material
    have the same, obstacles -1.

    Raises ValueError for another suffix, and for a run in the paper's mode without recorded forces.
    """
    if path.suffix.lower() != SUFFIX:
        raise ValueError(f'"{path}": a file for ParaView ends in {SUFFIX}')
    temporary = path.with_name(path.name + ".tmp")
    try:
        with h5py.File(temporary, "w", libver=("v110", "v110"), track_order=True) as file:
            root = file.create_group("VTKHDF", track_order=True)
            root.attrs["Version"], root.attrs["Type"] = np.array([2, 2]), np.bytes_("PartitionedDataSetCollection")
            assembly = root.create_group("Assembly", track_order=True)
            pieces = _pieces(run)
            for number, (name, piece) in enumerate(pieces.items()):
                group = root.create_group(name, track_order=True)
                group.attrs["Index"] = number
                _write_mesh(group, piece, run.times)
                assembly[name] = h5py.SoftLink(f"/VTKHDF/{name}")
            _write_frames(root, run, pieces)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


def _pieces(run: Run) -> dict[str, dict[str, Any]]:
    """For each body by name: its vertices (k,), and cells by kind as indices into these."""
    materials = _materials(run)
    found: dict[str, dict[str, Any]] = {}
    drawn = cells(run.topology)
    for body, name in enumerate(run.body_names):
        own = [(kind, elements[of == body]) for kind, elements, of in drawn if (of == body).any()]
        if own:
            vertices = np.unique(np.concatenate([elements.ravel() for _, elements in own]))
            local = [(kind, np.searchsorted(vertices, elements)) for kind, elements in own]
            name = name.replace("/", "|").replace(".", "_")  # which have a meaning in HDF5 and in ParaView's selections
            while name in found or name == "Assembly":
                name += "_"
            found[name] = {"body": body, "material": materials[body], "vertices": vertices, "cells": local}
    return found


def _materials(run: Run) -> list[int]:
    """A number for each body; bodies of one kind and material have the same, obstacles -1."""
    specs = {spec["name"]: spec for spec in run.scene.get("bodies", ())}
    known: dict[str, int] = {}
    found = []
    for name, kind in zip(run.body_names, run.body_kinds, strict=True):
        spec = specs.get(name, specs.get(name.rpartition("[")[0], {}))
        material = json.dumps([kind, spec.get("material")], sort_keys=True)
        found.append(-1 if kind == "obstacle" else known.setdefault(material, len(known)))
    return found


def _write_mesh(group: h5py.Group, piece: dict[str, Any], times: np.ndarray) -> None:
    """All but what changes."""
    count, steps_taken = len(piece["vertices"]), len(times)
    corners = np.concatenate([np.full(len(elements), elements.shape[1]) for _, elements in piece["cells"]])
    group.attrs["Version"], group.attrs["Type"] = np.array([2, 2]), np.bytes_("UnstructuredGrid")
    group["NumberOfPoints"], group["NumberOfCells"] = np.array([count]), np.array([len(corners)])
    group["NumberOfConnectivityIds"] = np.array([corners.sum()])
    kinds = np.array([CELL_TYPES[kind] for kind, _ in piece["cells"]], np.uint8)
    group["Types"] = np.repeat(kinds, [len(elements) for _, elements in piece["cells"]])
    group["Offsets"] = np.concatenate([[0], np.cumsum(corners)])
    group["Connectivity"] = np.concatenate([elements.ravel() for _, elements in piece["cells"]]).astype(np.int64)
    for name in ("body", "material"):
        group[f"CellData/{name}"] = np.full(len(corners), piece[name], np.int32)
    for name, width in (("Points", 3), ("PointData/velocity", 3), ("PointData/displacement", 3), ("PointData/pressure", None)):
        group.create_dataset(name, (steps_taken * count, *([width] if width else [])), "f4")
    steps = group.create_group("Steps")
    steps.attrs["NSteps"] = steps_taken
    steps["Values"] = times
    offsets = count * np.arange(steps_taken)
    nothing = np.zeros(steps_taken, np.int64)
    steps["PointOffsets"], steps["PartOffsets"], steps["NumberOfParts"] = offsets, nothing, nothing + 1
    steps["CellOffsets"], steps["ConnectivityIdOffsets"] = nothing[:, None], nothing[:, None]
    for name in ("velocity", "displacement", "pressure"):
        steps[f"PointDataOffsets/{name}"] = offsets
    for name in ("body", "material"):
        steps[f"CellDataOffsets/{name}"] = nothing


def _write_frames(root: Any, run: Run, pieces: dict[str, dict[str, Any]]) -> None:
    start = before = run.positions(0)
    for frame, pressure in enumerate(_pressures(run)):
        now = run.positions(frame)
        velocity = (now - before) / (run.times[frame] - run.times[frame - 1]) if frame else np.zeros_like(now)
        values = {
            "Points": now,
            "PointData/velocity": velocity,
            "PointData/displacement": now - start,
            "PointData/pressure": pressure,
        }
        for name, piece in pieces.items():
            vertices = piece["vertices"]
            for array, value in values.items():
                root[name][array][frame * len(vertices) : (frame + 1) * len(vertices)] = value[vertices]
        before = now


def _pressures(run: Run) -> Any:
    """(n,) Pa of each frame, at the vertices that the run, which may be an excerpt, has."""
    from pdipc.audit import vertex_forces
    from pdipc.export.export import Excerpt
    from pdipc.output.forces import pressures

    whole, frames, vertices = (run.whole, run.taken, run.vertices) if isinstance(run, Excerpt) else (run, None, slice(None))
    frames = list(range(whole.frame_count)) if frames is None else frames
    if not frames:
        raise RunError(f"{run.folder} has no frames")
    for frame, (normal, _) in zip(frames, vertex_forces(whole, frames), strict=True):
        yield pressures(normal, whole.positions(frame), whole.triangles)[vertices]
