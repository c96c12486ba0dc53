"""Pins that begin and end: a model holds what is held from one such time to the next, and a simulation changes models in between.

What a pin catches, it holds where it is: the points of a motion, or of an obstacle that it follows, are those that the pose of the moment
has there. They are part of the state, so that a run that goes on holds the same.
"""

from dataclasses import replace

import numpy as np

from pdipc.integration.script import rows_of_anchors
from pdipc.model import Model, State, reassembled
from pdipc.scene.assembly import AssembledPin, Assembly
from pdipc.scene.motion import Glue, Trajectory, pulled_back
from pdipc.scene.movers import movers_of

EARLY = 1e-6  # of a step: times add up with rounding


def model_at(model: Model, state: State) -> Model:
    """The model whose pins hold in a step from `state`: `model`, where these are the same. What is caught now is written into the state."""
    assembly = model.assembly
    time = state.time + EARLY * model.settings.time_step
    due = [pin.start <= time < pin.end for pin in assembly.pins]
    if all(pin.active == now for pin, now in zip(assembly.pins, due, strict=True)):
        return model
    pins, anchors = [], rows_of_anchors(assembly)
    for number, (pin, now) in enumerate(zip(assembly.pins, due, strict=True)):
        new = replace(pin, active=now)
        if now and not pin.active and pin.start > 0.0:
            caught_before = f"{number}_points" in state.reached.caught
            if not caught_before:
                state.reached.caught |= _catch(assembly, pin, number, state)
            new = _caught(new, number, state.reached.caught)
            if number in anchors and not caught_before:
                state.reached.anchors[anchors[number]] = assembly.pin_targets(new, state.time)
        pins.append(new)
    return reassembled(model, replace(assembly, pins=pins))


def _catch(assembly: Assembly, pin: AssembledPin, number: int, state: State) -> dict[str, np.ndarray]:
    """By which points a pin holds its vertices where they are, as arrays by name."""
    x = state.positions.numpy().astype(np.float64)
    points = x[pin.vertices]
    if pin.follow < 0:
        rotation, p = pin.trajectory.pose(state.time)
        return {f"{number}_points": pulled_back(points, rotation, pin.trajectory.center + p, pin.trajectory.center)}
    glue = assembly.glued(pin, x)
    parts = {"triangles": glue.triangles, "weights": glue.weights, "offsets": glue.offsets}
    if isinstance(assembly.bodies[pin.follow].trajectory, Trajectory):
        mover = next(mover for mover in movers_of(assembly) if mover.body == pin.follow)
        turn, place = state.reached.pose(mover)
        points = pulled_back(points, turn.as_matrix(), place, mover.origin)
    return {f"{number}_points": points} | {f"{number}_{name}": values for name, values in parts.items()}


def _caught(pin: AssembledPin, number: int, caught: dict[str, np.ndarray]) -> AssembledPin:
    glue = None
    if f"{number}_triangles" in caught:
        glue = Glue(*(caught[f"{number}_{name}"] for name in ("triangles", "weights", "offsets")))
    return replace(pin, points=caught[f"{number}_points"], glue=glue)
