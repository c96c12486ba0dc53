"""Small runs made by hand, without a simulation."""

import json

import numpy as np

from pdipc.output.results import RunWriter
from pdipc.scene import generators


def scene() -> dict:
    """A ball under a cloth above a floor: the scene in TOML's terms."""
    return {
        "simulation": {"steps": 8},
        "bodies": [
            {
                "name": "ball",
                "kind": "solid",
                "mesh": {"shape": "sphere", "radius": 0.25, "cells": 4},
                "translation": [0.0, 0.3, 0.0],
            },
            {
                "name": "cloth",
                "kind": "cloth",
                "mesh": {"shape": "grid", "size": [1.0, 1.0], "cells": [8, 8]},
                "translation": [0.0, 0.6, 0.0],
            },
        ],
        "obstacles": [{"name": "floor", "mesh": {"shape": "plane", "size": 40.0}}],
    }


def parts() -> tuple[np.ndarray, dict]:
    """Positions (n, 3) at the start, and the topology."""
    meshes = [
        generators.Sphere(shape="sphere", radius=0.25, cells=4).mesh(),
        generators.Grid(shape="grid", size=(1.0, 1.0), cells=(8, 8)).mesh(),
        generators.Plane(shape="plane", size=40.0).mesh(),
    ]
    first = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    heights = [0.3, 0.6, 0.0]
    positions = np.concatenate(
        [mesh.vertices + np.array([0.0, height, 0.0]) for mesh, height in zip(meshes, heights, strict=True)]
    )
    body_of_vertex = np.repeat(np.arange(3), np.diff(first))
    return positions, {
        "triangles": np.concatenate([mesh.triangles + shift for mesh, shift in zip(meshes, first, strict=False)]),
        "tets": np.concatenate([mesh.tets + shift for mesh, shift in zip(meshes, first, strict=False)]),
        "body_of_vertex": body_of_vertex,
        "scripted": body_of_vertex == 2,
        "body_names": ["ball", "cloth", "floor"],
        "body_kinds": ["solid", "cloth", "obstacle"],
    }


def move(state: np.ndarray) -> np.ndarray:
    """A step whose bits depend on all before it: the cloth sinks and ripples."""
    moved = state.copy()
    cloth = state[:, 1] > 0.4
    moved[cloth, 1] += np.float32(0.002) * np.sin(7 * state[cloth, 0] + state[cloth, 1] * 30)
    return moved


def advance(writer: RunWriter, state: np.ndarray, steps: range, checkpoint_every: int = 2) -> np.ndarray:
    """Takes the steps and writes each."""
    for step in steps:
        start, state = state, move(state)
        writer.append_segments(step, 0, start, state)
        writer.append(step, step * 0.01, state, {"outer": 1 + step % 3, "smallest_gap": 1e-3, "milliseconds": {"total": 1.0}})
        if step % checkpoint_every == 0:
            writer.checkpoint(step, {"positions": state, "time": np.float64(step * 0.01), "step": np.int64(step)})
    return state


def begin(folder, as_json: str | None = None, precision: str = "float32", **kwargs) -> tuple[RunWriter, np.ndarray]:
    """A new run with its start."""
    positions, topology = parts()
    state = positions.astype(precision)
    meta = {"device": "cpu", "precision": precision}
    writer = RunWriter.create(folder, as_json or json.dumps(scene()), topology, meta, **kwargs)
    writer.append(0, 0.0, state.astype(np.float64), {})
    writer.checkpoint(0, {"positions": state, "time": np.float64(0), "step": np.int64(0)})
    return writer, state


def write(folder, steps: int = 8, precision: str = "float32") -> np.ndarray:
    """A whole run; returns its last positions."""
    writer, state = begin(folder, precision=precision)
    with writer:
        return advance(writer, state, range(1, steps + 1))
