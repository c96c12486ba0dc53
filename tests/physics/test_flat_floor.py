"""A flat floor is flat, whatever its triangles: what slides on it, without friction, is not pushed along it."""

import numpy as np
import pytest

import pdipc

BODIES = {
    "ball": {"kind": "rigid", "mesh": {"shape": "sphere", "radius": 0.1, "cells": 8}, "translation": (0, 0.1015, 0)},
    "cube": {"kind": "rigid", "mesh": {"shape": "box", "size": (0.2,) * 3, "cells": (1,) * 3}, "translation": (0, 0.1015, 0)},
    "soft ball": {"kind": "solid", "mesh": {"shape": "sphere", "radius": 0.1, "cells": 5}, "translation": (0, 0.1015, 0)},
    "cloth": {"kind": "cloth", "mesh": {"shape": "grid", "cells": (12, 12), "size": (0.4, 0.4)}, "translation": (0, 0.0015, 0)},
    "rope": {"kind": "rod", "mesh": {"shape": "rope", "length": 0.4, "segments": 12}, "translation": (0, 0.0062, 0)},
}


def slide(body, cells, steps=30):
    """The most that the floor pushes sideways, over the weight; and the horizontal velocity at the end, m/s."""
    sliding = {"name": "body", "velocity": (0.5, 0, 0.2), "rotation": (0, 10, 0), **body}
    floor = {"name": "floor", "mesh": {"shape": "grid", "size": (2.0, 2.0), "cells": (cells, cells)}}
    made = pdipc.Scene(bodies=[sliding], obstacles=[floor], contact={"activation_distance": 2e-3, "friction": 0.0})
    simulation = pdipc.Simulation(made, device="cpu")
    mass = simulation.model.mass.numpy().astype(float)
    side, weight = 0.0, 9.81 * mass.sum()
    for _ in range(steps):
        result = simulation.step(forces=True)
        assert result.converged
        side = max(side, float(np.linalg.norm(result.forces.on("body").normal[[0, 2]])))
    velocity = (mass[:, None] * simulation.state.velocities.numpy()).sum(axis=0) / mass.sum()
    return side / weight, velocity[[0, 2]]


@pytest.mark.parametrize("name", BODIES)
def test_a_floor_of_many_triangles_pushes_nothing_sideways(name):
    side, velocity = slide(BODIES[name], 20)
    assert side < 1e-6
    assert np.abs(velocity - (0.5, 0.2)).max() < 2e-3  # what is left is the turning of a body within steps
    assert np.allclose(velocity, slide(BODIES[name], 2)[1], atol=1e-9)  # as on two triangles by two


def test_a_floor_that_is_bent_by_command_holds_by_its_edges_and_vertices():
    floor = {"name": "floor", "mesh": {"shape": "grid", "size": (1.0, 1.0), "cells": (2, 2)}}
    plate = {"name": "plate", "kind": "rigid", "mesh": {"shape": "box", "size": (0.3, 0.02, 0.3), "cells": (1, 1, 1)}}
    made = pdipc.Scene(bodies=[{**plate, "translation": (0, 0.1, 0)}], obstacles=[floor], contact={"activation_distance": 2e-3})
    simulation = pdipc.Simulation(made, device="cpu")
    vertices = simulation.positions[simulation.model.assembly.obstacle]
    vertices[np.abs(vertices).max(axis=1) < 0.1, 1] = 0.07  # the one in the middle
    simulation.set_vertices("floor", vertices)
    for _ in range(20):
        result = simulation.step()
        assert result.converged and result.lag == 0.0
        assert not len(pdipc.find_intersections(simulation.positions, simulation.triangles, simulation.model.assembly.obstacle))
    assert simulation.positions[:8, 1].mean() > 0.07  # on the tip
