"""Obstacles that are held up by what they push: they go as far as the step allows, and a converged step is one where they arrive."""

import numpy as np

import pdipc


def test_closing_boards_arrive():
    boards = [
        {
            "name": name,
            "mesh": {"shape": "box", "size": [1.0, 0.05, 1.0], "cells": [1, 1, 1]},
            "translation": [0.0, side * 0.13, 0.0],
            "motion": {"velocity": [0.0, -side * 1.0, 0.0], "end": 0.05},
        }
        for name, side in (("lower", -1), ("upper", 1))
    ]
    block = {"name": "block", "kind": "solid", "mesh": {"shape": "box", "size": [0.2, 0.2, 0.2], "cells": [3, 3, 3]}}
    simulation = pdipc.Simulation(pdipc.Scene(simulation={"gravity": [0, 0, 0]}, bodies=[block], obstacles=boards), "cpu")
    assembly = simulation.model.assembly
    for _ in range(8):
        result = simulation.step()
        lag = np.abs(simulation.positions[assembly.kinematic_vertices] - assembly.kinematic_positions(simulation.state.time))
        assert lag.max() < 1e-9 or not result.converged
        assert len(pdipc.find_intersections(simulation.positions, simulation.triangles, assembly.scripted)) == 0
    assert lag.max() < 1e-9
