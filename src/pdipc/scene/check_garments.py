"""What keeps garments and closed cloth from being simulated."""

from collections.abc import Iterator

import numpy as np

from pdipc.scene import meshes
from pdipc.scene.assembly import AssembledBody, Assembly
from pdipc.scene.finding import Finding
from pdipc.scene.schema import Cloth, ClothMaterial

WARP = (1.0, 0.0, 0.0)  # the default
MOST_STRETCH = 5.0  # of a triangle at the start: more is no shape of its pattern


def check_garments(assembly: Assembly) -> Iterator[Finding]:
    """Findings about what cloths hold, and how they are sewn."""
    for stitch in assembly.stitches:
        if len(stitch.elements) == 0:
            yield Finding(stitch.where, "sews no vertex", 'raise "within", or give pairs')
    for body in assembly.bodies:
        yield from _stretched(assembly, body)
        yield from _across(assembly, body)
        if body.inside is not None:
            yield from _closed(body)


def cloth_settings(body: Cloth, newton: bool) -> Iterator[Finding]:
    """Settings of a cloth that do not go together, or not with the solver."""
    where, m = f'body "{body.name}"', body.material
    if not newton:
        named = {"inside": body.inside, "material.strain_limit": m.strain_limit}
        named |= {f"material.{name}": getattr(m, name) for name in ("weft_stiffness", "shear_stiffness")}
        for name, value in named.items():
            if value is not None:
                yield Finding(
                    f"{where}: {name}", "needs the Newton solver", "leave it out, or take the barrier's contact and newton"
                )
    if body.weld and body.open_seams:
        yield Finding(f"{where}: open_seams", "is given beside weld", "leave one of them out")
    own = next((name for name in ("rest", "weld", "open_seams") if getattr(body, name) is not None), None)
    if own is not None:
        for name, value, right in (("membrane", "springs", "strain"), ("bending", "curved", "quadratic")):
            if getattr(m, name) == value:
                found = f'is "{value}", which takes its rest shape from the mesh, and with `{own}` that is another'
                yield Finding(f"{where}: material.{name}", found, f'take "{right}"')


def stretches(assembly: Assembly, body: AssembledBody) -> tuple[np.ndarray, np.ndarray]:
    """(m,) the smallest and the largest stretch of each triangle of a cloth at the start, 1 at rest."""
    shape = body.elastic_shape
    rest = assembly.rest_positions[body.triangles] if shape is None else shape[0].reshape(-1, 3, 3)

    def metric(corners: np.ndarray) -> np.ndarray:
        sides = corners[:, 1:] - corners[:, :1]
        return np.einsum("tid,tjd->tij", sides, sides)

    squares = np.linalg.eigvals(np.linalg.solve(metric(rest), metric(assembly.positions[body.triangles]))).real
    found = np.sqrt(np.clip(squares, 0.0, None))
    return found.min(axis=1), found.max(axis=1)


def _stretched(assembly: Assembly, body: AssembledBody) -> Iterator[Finding]:
    """What starts in no shape that its rest shape could have."""
    m = body.material
    if not isinstance(m, ClothMaterial) or (body.pattern is None and m.strain_limit is None):
        return
    shape = body.elastic_shape
    rest, corners = (assembly.rest_positions, body.triangles) if shape is None else shape
    if meshes.flat_triangles(rest, corners).any():
        return  # found elsewhere
    least, most = stretches(assembly, body)
    worst = int(np.argmax(most))
    where = f'body "{body.name}"'
    if body.pattern is not None and (most[worst] > MOST_STRETCH or least.min() < 1.0 / MOST_STRETCH):
        worst = worst if most[worst] > MOST_STRETCH else int(np.argmin(least))
        found = f"triangles[{worst}] starts {most[worst]:.3g} times as long one way as in the pattern, and {least[worst]:.3g} times the other"
        yield Finding(
            f"{where}: rest", found, "triangles of mesh and pattern must correspond one to one; `scale` is metres in a unit"
        )
    elif m.strain_limit is not None and most[worst] - 1.0 > m.strain_limit:
        found = f"is {m.strain_limit:g}, but triangles[{worst}] starts stretched by {most[worst] - 1.0:.3g}"
        yield Finding(f"{where}: material.strain_limit", found, "raise it, or start nearer to the rest shape")


def _across(assembly: Assembly, body: AssembledBody) -> Iterator[Finding]:
    """Woven cloth with triangles that have no direction of warp."""
    m = body.material
    if not isinstance(m, ClothMaterial) or not m.has_warp:
        return
    shape = body.elastic_shape
    corners = assembly.rest_positions[body.triangles] if shape is None else shape[0].reshape(-1, 3, 3)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    warp = np.array(m.warp or WARP)
    size = np.linalg.norm(normal, axis=1) * np.linalg.norm(warp)
    bad = np.flatnonzero(np.linalg.norm(np.cross(normal, warp), axis=1) < 2e-3 * size)
    if len(bad):
        found = f"{warp.tolist()} is across {len(bad)} of {len(corners)} triangles, first triangles[{bad[0]}]"
        yield Finding(f'body "{body.name}": material.warp', found, "give another direction, or a flat pattern as `rest`")


def _closed(body: AssembledBody) -> Iterator[Finding]:
    where = f'body "{body.name}": inside'
    sides = np.sort(body.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    edges, counts = np.unique(sides, axis=0, return_counts=True)
    rim = edges[counts == 1]
    if len(rim):
        found = f"holds nothing: {len(rim)} edges of the cloth have a triangle on one side only, first {(rim[0] - body.first).tolist()}"
        yield Finding(where, found, "only a closed surface holds something; `weld` closes seams whose vertices coincide")
    elif not meshes.is_closed(body.triangles):
        yield Finding(where, "has no inner side: neighbouring triangles are turned differently", "turn all of them alike")
