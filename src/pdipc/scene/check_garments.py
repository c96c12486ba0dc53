"""What keeps garments and closed cloth from being simulated."""

from collections.abc import Iterator

import numpy as np

from pdipc.scene import meshes
from pdipc.scene.assembly import AssembledBody, Assembly
from pdipc.scene.finding import Finding


def check_garments(assembly: Assembly) -> Iterator[Finding]:
    """Findings about what cloths hold, and how they are sewn."""
    for stitch in assembly.stitches:
        if len(stitch.elements) == 0:
            yield Finding(stitch.where, "sews no vertex", 'raise "within", or give pairs')
    for body in assembly.bodies:
        if body.inside is not None:
            yield from _closed(body)


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
