"""Pins that begin and end: a model holds what is held from one such time to the next, and a simulation changes models in between.

What a pin catches, it holds where it is: the points of a motion, or of an obstacle that it follows, are those that the pose of the moment
has there. They are part of the state, so that a run that goes on holds the same.
"""

from dataclasses import replace

import numpy as np

from pdipc.integration.script import anchored_pins
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
    pins = []
    for number, (pin, now) in enumerate(zip(assembly.pins, due, strict=True)):
        if now and not pin.active and pin.start > 0.0:
            if f"{number}_points" not in state.reached.caught:
                state.reached.caught |= _catch(assembly, pin, number, state)
            pin = _caught(pin, number, state.reached.caught)
        pins.append(replace(pin, active=now))
    after = replace(assembly, pins=pins)
    state.reached.anchors = _anchors(assembly, after, state)
    return reassembled(model, after)


def _anchors(before: Assembly, after: Assembly, state: State) -> np.ndarray:
    """(k, 3) m: where springs of pins end, of those that go on where they were."""
    old, ends = anchored_pins(before), np.cumsum([0, *(len(before.pins[pin].vertices) for pin in anchored_pins(before))])
    known = len(state.reached.anchors) == ends[-1]
    parts = [np.zeros((0, 3))]
    for pin in anchored_pins(after):
        k = old.index(pin) if pin in old and known else -1
        own = after.pins[pin]
        parts.append(after.pin_targets(own, state.time) if k < 0 else state.reached.anchors[ends[k] : ends[k + 1]])
    return np.concatenate(parts)


def _catch(assembly: Assembly, pin: AssembledPin, number: int, state: State) -> dict[str, np.ndarray]:
    """By which points a pin holds its vertices where they are, as arrays by name."""
    x = state.positions.numpy().astype(np.float64)
    points = x[pin.vertices]
    if pin.follow < 0:
        rotation, p = pin.trajectory.pose(state.time)
        return {f"{number}_points": pulled_back(points, rotation, pin.trajectory.center + p, pin.trajectory.center)}
    if not isinstance(assembly.bodies[pin.follow].trajectory, Trajectory):
        glue = assembly.glued(pin, x)
        parts = {"triangles": glue.triangles, "weights": glue.weights, "offsets": glue.offsets}
        return {f"{number}_points": points} | {f"{number}_{name}": values for name, values in parts.items()}
    mover = next(mover for mover in movers_of(assembly) if mover.body == pin.follow)
    turn, place = state.reached.pose(mover)
    return {f"{number}_points": pulled_back(points, turn.as_matrix(), place, mover.origin)}


def _caught(pin: AssembledPin, number: int, caught: dict[str, np.ndarray]) -> AssembledPin:
    glue = None
    if f"{number}_triangles" in caught:
        glue = Glue(*(caught[f"{number}_{name}"] for name in ("triangles", "weights", "offsets")))
    return replace(pin, points=caught[f"{number}_points"], glue=glue)
