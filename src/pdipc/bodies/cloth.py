"""A cloth's part of a model: the constraints of its sheet, of its seams, and of what it holds."""

import dataclasses

import numpy as np

from pdipc import constraints
from pdipc.constraints import (
    curved_bending,
    edge_length,
    enclosed_volume,
    material,
    quadratic_bending,
    stitch,
    strain_limit,
    triangle_area,
    triangle_strain,
    triangles,
    woven,
    woven_bending,
)
from pdipc.scene.assembly import AssembledBody, Assembly
from pdipc.scene.check_garments import WARP
from pdipc.scene.schema import ClothMaterial


def elasticity(assembly: Assembly, body: AssembledBody, newton: bool) -> tuple[list[constraints.ConstraintSet], np.ndarray]:
    """The constraints of a cloth, and the masses (n,) kg of its vertices among all."""
    x, m = assembly.rest_positions, body.material
    assert isinstance(m, ClothMaterial)
    assert m.membrane_stiffness is not None  # its validator has set it
    shape = body.elastic_shape
    rest, corners = (x, body.triangles) if shape is None else shape
    sets = []
    if m.membrane == "springs":
        edges, stiffness = material.springs(x, body.triangles, m.membrane_stiffness)
        sets.append(edge_length.rest(x, edges, stiffness))
    else:
        strain, area = material.cloth(m.membrane_stiffness, m.poisson_ratio)
        if m.is_woven:
            law = material.woven(
                m.membrane_stiffness, m.weft_stiffness or m.membrane_stiffness, m.shear_stiffness, m.poisson_ratio
            )
            sets.append(woven.rest(rest, corners, law, m.warp or WARP))
            area = 0.0
        else:
            sets.append(triangle_strain.rest(rest, corners, strain))
        area += 2.0 * m.area_stiffness  # a change of area of tr(e) costs w / 2 of tr(e)^2 / 2
        if area > 0.0:
            sets.append(triangle_area.rest(rest, corners, area))
    if m.strain_limit:
        stiffest = max(m.membrane_stiffness, m.weft_stiffness or 0.0)
        sets.append(strain_limit.rest(rest, corners, stiffest, m.strain_limit))
    if shape is not None:  # elements of the pattern act on the vertices that it is sewn to
        sets = [dataclasses.replace(s, vertices=body.triangles) for s in sets]
    if m.bending_stiffness:
        if m.bending == "curved":
            sets.append(curved_bending.rest(x, body.triangles, m.bending_stiffness))
        elif m.weft_bending_stiffness:
            stiffness = m.bending_stiffness, m.weft_bending_stiffness
            sets.append(woven_bending.rest(x, body.triangles, *stiffness, m.warp or WARP, body.pattern))
        else:
            sets.append(quadratic_bending.rest(x, body.triangles, m.bending_stiffness, body.pattern))
    if body.inside is not None:
        outward, cavity, _ = cavities(assembly, body)
        sets.append(enclosed_volume.rest(outward, cavity, np.tile([0.0, 0.0, 1.0, 0.0, 1.0], (len(cavity), 1))))
    mass = material.lumped_mass(len(x), body.triangles, m.areal_density * triangles.rest_shape(rest, corners)[1])
    return sets, mass


def speed_of_sound(m: ClothMaterial) -> float:
    """m/s, along the sheet."""
    assert m.membrane_stiffness is not None  # its validator has set it
    return float(np.sqrt(m.membrane_stiffness / m.areal_density))


def seams(assembly: Assembly) -> list[constraints.ConstraintSet]:
    """The threads of all stitches, as they are at the start."""
    return [stitch.rest(s.elements, s.weights, s.stiffness, s.lengths(0.0)) for s in assembly.stitches]


def thread_lengths(assembly: Assembly, time: float) -> np.ndarray:
    """(k,) m: the lengths of all threads at `time`, s, in the order of `seams`."""
    return np.concatenate([s.lengths(time) for s in assembly.stitches])


def cavities(assembly: Assembly, body: AssembledBody) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The triangles (m, 3) of a closed cloth, turned outward, and for each its cavity (m,) and the volume of that at the start (m,), m^3."""
    cavity = enclosed_volume.cavities(body.triangles)
    volume = enclosed_volume.volumes(assembly.positions, body.triangles, cavity)
    outward = np.where((volume < 0.0)[:, None], body.triangles[:, ::-1], body.triangles)
    return outward, cavity, np.abs(volume)


class Fillings:
    """What the cavities of all bodies hold, and their volumes at the start: `Inside` tables and (c,) m^3 of each body that holds something."""

    def __init__(self, assembly: Assembly):
        self.of_bodies = []
        for body in assembly.bodies:
            if body.inside is not None:
                _, cavity, volume = cavities(assembly, body)
                self.of_bodies.append((body.inside, volume[np.unique(cavity, return_index=True)[1]]))

    def laws(self, time: float) -> np.ndarray:
        """(c, 5) the law of each cavity at `time`, s, in the order of their first vertices; see `constraints.enclosed_volume`."""
        rows = [inside.law(time, volume) for inside, volumes in self.of_bodies for volume in volumes]
        return np.array(rows).reshape(-1, enclosed_volume.LAW)
