"""What the activation distance and the precision mean beside bodies and steps, and a pressure beside cloth: hints, not findings, since any is feasible.

A step that goes over many activation distances meets the barrier only after CCD has cut it, again and again; and a body of few of them is held off by
an air gap that can be seen. Where many and few begin is a choice.

Sound, of the speed c = sqrt(E / rho), crosses c h / l elements of the size l in a step h, and the square of that number is a body's elastic stiffness over its
inertia. Where rounding times it is more than one, what rounds in elastic forces is more than inertia. Measured in float32: four scenes of small stiff bodies
with 5e7 to 1e9 ended 11 of 48 steps at the cap of outer iterations, in float64 1 of 48; a single body with up to 3e8 none of 60.

A sphere of radius r whose membrane is stretched by s pulls with T = Y / (1 - nu) (s - 1) / s, and holds the pressure 2 T / (s r) (Laplace): at most Y / (1 - nu) / 2 r, at s = 2. A constant
pressure above that inflates it without end, as measured: with 1.0 times it a ball of 384 triangles rests at s = 1.84, with 1.1 times it is gone.
"""

import itertools

import numpy as np

from pdipc.scene.assembly import Assembly
from pdipc.scene.meshes import triangle_areas
from pdipc.scene.schema import ClothMaterial, Scene, SolidMaterial
from pdipc.scene.sewing import parts

STIFF = 2.0  # times single precision's unit roundoff: the square of the elements that sound may cross in a step
FAR, THICK = 100.0, 0.05  # activation distances that a step may go over; and their part of a body's size
MOMENTS = 60  # of the run, between which scripted vertices are looked at


def hints(scene: Scene, assembly: Assembly) -> list[str]:
    """A line for each body whose start or script goes over many activation distances a step, for each that is thin beside one, for each solid that
    is too stiff for float32, and for each cloth that cannot hold its pressure.
    """
    d_hat, h = assembly.activation_distance, scene.simulation.time_step
    found = []
    for body in assembly.bodies:
        own = slice(body.first, body.last)
        speed = _scripted(scene, assembly, body) if body.kinematic else _largest(assembly.velocities[own])
        if np.isfinite(speed) and speed * h > FAR * d_hat:
            found.append(
                f'"{body.name}" moves {speed:.3g} m/s, {speed * h / d_hat:.0f} times the activation distance of {d_hat:.3g} m '
                f"a step: steps in contact may take many outer iterations; a time step of {FAR * d_hat / speed:.2g} s, or an "
                f"activation distance of {speed * h / FAR:.2g} m, may take fewer"
            )
        size = float(np.linalg.norm(np.ptp(assembly.positions[own], axis=0)))
        if not body.kinematic and d_hat > THICK * size:
            found.append(
                f'the activation distance of {d_hat:.3g} m is {100 * d_hat / size:.0f} % of the size of "{body.name}", '
                f"{size:.3g} m, so others are felt from that far; {1e-3 * size:.2g} m would be the default for it alone"
            )
    if scene.simulation.precision == "float32":
        found += unresolved(scene, assembly)
    return found + bursting(assembly)


def unresolved(scene: Scene, assembly: Assembly) -> list[str]:
    """A line for each solid that is too stiff for float32."""
    found, most = [], np.sqrt(STIFF / 2.0**-24)
    for body in assembly.bodies:
        if body.kind != "solid" or not len(body.tets):
            continue
        assert isinstance(body.material, SolidMaterial)
        corners = assembly.positions[body.tets]
        element = float(
            min(np.linalg.norm(corners[:, a] - corners[:, b], axis=1).min() for a, b in itertools.combinations(range(4), 2))
        )
        h = scene.simulation.time_step
        speed = np.sqrt(body.material.young_modulus / body.material.density)
        crossed = speed * h / scene.simulation.substeps / element if element > 0.0 else 0.0
        if crossed > most:
            found.append(
                f'sound crosses {crossed:.0f} elements of "{body.name}" in a step, and with more than {most:.0f} what float32 rounds in elastic forces '
                f"outweighs inertia, so steps may not converge: use float64, a rigid body, or a time step of {h * most / crossed:.2g} s"
            )
    return found


def bursting(assembly: Assembly) -> list[str]:
    """A line for each cloth that its pressure inflates without end."""
    found = []
    for body in assembly.bodies:
        m = body.material
        if body.inside is None or body.inside.pressure is None or not isinstance(m, ClothMaterial):
            continue
        if m.strain_limit is not None or m.area_stiffness > 0.0 or m.membrane == "springs":
            continue  # what pulls the more the farther it is stretched
        used, part = parts(body.triangles)
        corners = (assembly.rest_positions, body.triangles) if body.elastic_shape is None else body.elastic_shape
        area = np.bincount(part[np.searchsorted(used, body.triangles[:, 0])], weights=triangle_areas(*corners))
        radius = float(np.sqrt(area.max() / (4.0 * np.pi)))
        stiffness = max(m.membrane_stiffness or 0.0, m.weft_stiffness or 0.0)
        most = stiffness / (1.0 - m.poisson_ratio) / (2.0 * radius)
        if body.inside.pressure > most:
            found.append(
                f'a pressure of {body.inside.pressure:.3g} Pa inflates "{body.name}" without end: a ball of its cloth, {radius:.3g} m in radius, holds '
                f"{most:.3g} Pa; give it a larger membrane_stiffness, a strain_limit, or a gas in place of the pressure"
            )
    return found


def _largest(vectors: np.ndarray) -> float:
    return float(np.linalg.norm(vectors, axis=1).max(initial=0.0))


def _scripted(scene: Scene, assembly: Assembly, body) -> float:
    """m/s: the fastest vertex of an obstacle, between moments of the run."""
    if body.trajectory is None or body.trajectory.is_static:
        return 0.0
    start = assembly.positions[body.first : body.last]
    times = np.linspace(0.0, scene.simulation.time_step * max(1, scene.simulation.steps), MOMENTS + 1)
    places = [body.trajectory.apply(start, time) for time in times]
    return max(_largest(after - before) for before, after in itertools.pairwise(places)) / (times[1] - times[0])
