"""A pdipc model solved by IPC: the same masses, constraints, barrier and forces, read from the model as arrays.

Only data cross over. What is made of them, energies, their derivatives, contact and the solver, is this package's own.
"""

from typing import Any

import numpy as np

from . import contact, energies, ipc


def terms_of(sets) -> list[energies.Term]:
    """The energies of pdipc's constraint sets. Raises ValueError for a kind that this package does not know."""

    def manifold(s):
        if s.kind in ("tet_strain", "triangle_strain"):
            return energies.nearest_isometry()
        if s.kind in ("tet_volume", "triangle_area"):
            return energies.unit_product()
        if s.kind in ("edge_length", "quadratic_bending", "curved_bending"):
            return energies.Length(s.data["length"])
        if s.kind == "point_attachment":
            return energies.Fixed(np.asarray(s.data["point"])[:, :, None])
        raise ValueError(f"constraint kind {s.kind!r} is unknown to the baselines")

    return [energies.Term(s.vertices, s.gradient, s.weight, manifold(s)) for s in sets]


class Reference:
    """IPC on a pdipc model (built with substeps = 1), from its initial state on. state: positions and velocities, (n, 3)."""

    def __init__(self, model):
        a, settings = model.assembly, model.settings
        kinematic = model.free.numpy() == 0
        surface = contact.Surface(a.rest_positions, a.triangles, kinematic)
        touching = contact.DistanceBarrier(
            surface,
            a.rest_positions,
            stiffness=model.kappa.numpy().astype(float),
            activation=settings.activation_distance,
            separation=model.half_separation.numpy().astype(float),
            body=a.body_of_vertex,
            friction=model.friction.numpy().astype(float),
            slip=settings.slip_threshold,
        )
        self.model, self.time = model, 0.0
        self.problem = ipc.Problem(
            model.mass.numpy().astype(float),
            terms_of(model.projector.sets),
            settings.time_step,
            kinematic,
            touching,
            gravity=(0.0, 0.0, 0.0),  # among the model's accelerations
            damping=settings.damping,
        )
        self.state = ipc.State(a.positions.copy(), a.velocities.copy())

    def step(self, **options) -> ipc.Info:
        """One step of h; options as for `ipc.step`."""
        model, a = self.model, self.model.assembly
        acceleration = model.external.accelerations(self.time, self.state.positions, self.state.velocities)
        self.time += self.problem.time_step
        soft = [pin for pin in a.pins if pin.stiffness is not None and len(pin.vertices)]
        held: list[Any] = [  # of points, which have `values`
            t.manifold for s, t in zip(model.projector.sets, self.problem.terms, strict=True) if s.kind == "point_attachment"
        ]
        for pin, manifold in zip(soft, held, strict=True):
            manifold.values = a.pin_targets(pin, self.time)[:, :, None]
        targets = model.kinematic_targets(self.time)
        self.state, info = ipc.step(self.problem, self.state, targets=targets, acceleration=acceleration, **options)
        return info
