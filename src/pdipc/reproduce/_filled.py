"""Surfaces of the optional data as solids: remeshed and filled with tets by their winding number, once, and kept.

What is inside is told by the generalized winding number (Jacobson et al. 2013), so holes, edges that more than two triangles
share, and parts that overlap need no repair; `pdipc.scene.stuffing` makes the tets.
"""

import hashlib
import os
from pathlib import Path

import numpy as np
import warp as wp

from pdipc.device.language import kernel
from pdipc.device.system import start_warp
from pdipc.scene.meshes import Mesh, boundary
from pdipc.scene.stuffing import stuffed

VERSION = b"2"  # of what is kept
CLOSE = 0.02  # parts of the number of elements asked for
TRIES = 8
DENSE = 2.7  # elements grow about with this power of the lattice's resolution


def cache() -> Path:
    """Where solids are kept: the folder PDIPC_CACHE, else pdipc in the user's folder for caches."""
    named = os.environ.get("PDIPC_CACHE")
    return Path(named) if named else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "pdipc"


def filled(
    vertices: np.ndarray, triangles: np.ndarray, elements: int, label: str, surface_splits: int = 0
) -> dict[str, np.ndarray]:
    """A mesh table of a scene, of about so many tets: what the triangles (m, 3) of the vertices (n, 3) enclose.

    surface_splits: how many edges of the surface are then halved, the longest first; each makes a vertex and three or four tets.
    """
    vertices, triangles = np.asarray(vertices, dtype=np.float64), np.asarray(triangles, dtype=np.int32)
    digest = hashlib.sha256(
        VERSION + vertices.tobytes() + triangles.tobytes() + f"{elements} {surface_splits}".encode()
    ).hexdigest()[:24]
    file = cache() / f"{digest}.npz"
    if file.is_file():
        arrays = np.load(file)
        return {"vertices": arrays["V"], "tets": arrays["T"]}
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    scale = float((high - low).max())
    level = _enclosed((vertices - low) / scale, triangles)
    cells = 40.0

    def made() -> Mesh:
        return stuffed(level, np.zeros(3), (high - low) / scale, 1.0 / cells)

    mesh = made()
    for _ in range(TRIES - 1):
        ratio = elements / len(mesh.tets)
        if abs(ratio - 1.0) < CLOSE:
            break
        cells *= ratio ** (1.0 / DENSE)
        mesh = made()
    points, tets = with_finer_surface(mesh.vertices, mesh.tets, surface_splits)
    print(f"{label}: {len(triangles)} triangles filled with {len(tets)} tets, {len(points)} vertices", flush=True)
    found = {"V": scale * points + low, "T": tets}
    file.parent.mkdir(parents=True, exist_ok=True)
    temporary = file.with_suffix(f".{os.getpid()}.tmp.npz")
    np.savez_compressed(temporary, **found)
    os.replace(temporary, file)
    return {"vertices": found["V"], "tets": found["T"]}


def with_finer_surface(points: np.ndarray, tets: np.ndarray, splits: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and tets after so many edges of the surface were halved, the longest first; the shape stays."""
    while splits > 0:
        sides = np.sort(tets[:, [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]].reshape(-1, 2), axis=1)
        key = sides[:, 0].astype(np.int64) * len(points) + sides[:, 1]
        order = np.argsort(key, kind="stable")
        edges = np.unique(np.sort(boundary(tets)[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
        edges = edges[np.argsort(-np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1), kind="stable")]
        own = edges[:, 0].astype(np.int64) * len(points) + edges[:, 1]
        first, last = (np.searchsorted(key[order], own, side) for side in ("left", "right"))
        taken, parent, cut = np.zeros(len(tets), dtype=bool), [], []
        for edge, a, b in zip(range(len(edges)), first, last, strict=True):
            around = order[a:b] // 6
            if len(cut) < splits and not taken[around].any():
                taken[around] = True
                parent.append(around)
                cut.append(edge)
        ends, middles = edges[cut], len(points) + np.arange(len(cut))
        which, whole = np.repeat(np.arange(len(cut)), [len(each) for each in parent]), tets[np.concatenate(parent)]
        halves = [np.where(whole == ends[which, end, None], middles[which, None], whole) for end in (0, 1)]
        points = np.concatenate([points, points[ends].mean(axis=1)])
        tets = np.concatenate([tets[~taken], *halves]).astype(tets.dtype)
        splits -= len(cut)
    return points, tets


@kernel(wp.get_module(__name__))
def _distances(mesh: wp.uint64, points: wp.array(dtype=wp.vec3), reach: float, out: wp.array(dtype=float)):
    i = wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach, 2.0, 0.5)
    out[i] = reach
    if query.result:
        near = wp.mesh_eval_position(mesh, query.face, query.u, query.v)
        out[i] = query.sign * wp.length(near - points[i])


def _enclosed(vertices: np.ndarray, triangles: np.ndarray):
    """The level set of a surface within the unit box."""
    start_warp()
    mesh = wp.Mesh(
        points=wp.array(vertices, dtype=wp.vec3, device="cpu"),
        indices=wp.array(triangles.ravel(), dtype=wp.int32, device="cpu"),
        support_winding_number=True,
    )

    def level(x: np.ndarray) -> np.ndarray:
        points, out = wp.array(x, dtype=wp.vec3, device="cpu"), wp.zeros(len(x), dtype=float, device="cpu")
        wp.launch(_distances, dim=len(x), inputs=[mesh.id, points, 4.0], outputs=[out], device="cpu")
        return out.numpy().astype(np.float64)

    return level
