"""Culling finds every pair that brute force finds, whichever way it is done, and lists them in one order."""

import data
import numpy as np
import pytest
import warp as wp

from pdipc.collision import broad_phase, patches, surface
from pdipc.device.launch import Device
from pdipc.device.precision import real
from pdipc.scene import generators

METHODS = ("bvh", "patches")


def sheet(cells, height, waves=0.0):
    mesh = generators.Grid(size=(1.0, 1.0), cells=(cells, cells)).mesh()
    x = mesh.vertices.copy()
    x[:, 1] = height + waves * np.sin(14.0 * x[:, 0]) * np.cos(9.0 * x[:, 2])
    return x, mesh.triangles


def scene(rng, *, kinematic_last=True):
    """Two sheets close above each other, the upper folded, and a ball: rest positions, triangles, body, kinematic, motion."""
    parts = [sheet(9, 0.0), sheet(7, 0.02, 0.05)]
    ball = generators.Sphere(radius=0.2, cells=4).mesh()
    parts.append((ball.vertices + np.array([0.1, 0.2, 0.0]), ball.triangles))
    count = np.cumsum([0] + [len(x) for x, _ in parts])
    rest = np.concatenate([x for x, _ in parts])
    triangles = np.concatenate([t + first for (_, t), first in zip(parts, count, strict=False)])
    body = np.repeat(np.arange(3), np.diff(count))
    kinematic = (body == 2) & kinematic_last
    x0 = rest + 0.02 * rng.standard_normal(rest.shape)
    x1 = x0 + 0.03 * rng.standard_normal(rest.shape)
    reach = rng.uniform(0.001, 0.02, len(rest))
    return rest, triangles, body, kinematic, x0, x1, reach


def search(method, precision, rest, triangles, body, kinematic, x0, x1, reach, threads=None):
    device, number = Device("cpu", threads), real(precision)
    skin = surface.build(device, triangles, rest, body, kinematic)
    found = broad_phase.BroadPhase(device, number, skin, method)
    arrays = [wp.array(v, dtype=number.vec3, device="cpu") for v in (x0, x1)]
    arrays.append(wp.array(reach, dtype=number.scalar, device="cpu"))
    found.restructure(arrays[0], arrays[2])
    while True:
        found.find(*arrays)
        if not found.grow():
            break
    pairs = [each.pairs.numpy()[: each.count.numpy()[0]] for each in found.lists]
    return skin, found, pairs


def brute_force(skin, kinematic, x0, x1, reach):
    """Sets of (vertex, triangle) and (edge, later edge) whose boxes overlap as they move, in float64."""

    def overlapping(a, b):
        above, below = (np.ones((3, len(a), len(b)), dtype=bool) for _ in range(2))  # a's box and b's, at both ends
        for x in (x0, x1):
            low, high = x - reach[:, None], x + reach[:, None]
            for axis in range(3):
                above[axis] &= low[a, axis].min(axis=1)[:, None] > high[b, axis].max(axis=1)
                below[axis] &= high[a, axis].max(axis=1)[:, None] < low[b, axis].min(axis=1)
        meet = ~(above | below).any(axis=0)
        shared = (a[:, None, :, None] == b[None, :, None, :]).any(axis=(2, 3))
        still = kinematic[a].all(axis=1)[:, None] & kinematic[b].all(axis=1)[None]
        return np.argwhere(meet & ~shared & ~still)

    vertices, edges, faces = skin.members
    vertex_triangle = overlapping(vertices, faces)
    vertex_triangle[:, 0] = vertices[vertex_triangle[:, 0], 0]
    edge_edge = overlapping(edges, edges)
    return vertex_triangle, edge_edge[edge_edge[:, 0] < edge_edge[:, 1]]


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("kinematic", [True, False])
def test_all_that_brute_force_finds(method, precision, kinematic):
    for seed in range(3):
        rest, triangles, body, still, x0, x1, reach = scene(np.random.default_rng(seed), kinematic_last=kinematic)
        number = np.dtype(precision)
        x0, x1, reach = (np.asarray(v, dtype=number).astype(np.float64) for v in (x0, x1, reach))
        skin, _, pairs = search(method, precision, rest, triangles, body, still, x0, x1, reach)
        for found, expected in zip(pairs, brute_force(skin, still, x0, x1, reach), strict=True):
            found_set, expected_set = set(map(tuple, found)), set(map(tuple, expected))
            assert len(expected_set) > 100
            assert expected_set <= found_set
            # boxes are rounded outward to float32: little more than brute force finds
            assert len(found_set) <= 1.01 * len(expected_set)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_one_order(precision):
    """The same list from both, for any number of threads: a run's bits do not depend on the culling."""
    problem = scene(np.random.default_rng(5))
    _, _, expected = search("bvh", precision, *problem)
    for method in METHODS:
        for threads in (1, 3):
            _, _, pairs = search(method, precision, *problem, threads=threads)
            for a, b in zip(pairs, expected, strict=True):
                assert np.array_equal(a, b)
    first, second = expected[1].T
    assert np.all((np.diff(first) > 0) | ((np.diff(first) == 0) & (np.diff(second) > 0)))


def test_patches_are_voxels():
    """Every primitive is in one patch, no patch is over its width, and the tree's boxes hold what is below them."""
    rest, triangles, body, still, x0, x1, reach = scene(np.random.default_rng(1))
    skin, found, pairs = search("patches", "float64", rest, triangles, body, still, x0, x1, reach)
    culling = found.searcher
    for starts, members in zip(culling.starts, skin.members, strict=True):
        assert starts[0] == 0
        assert starts[-1] == len(members)
        assert np.diff(starts).min() >= 0
        assert np.diff(starts).max() <= patches.WIDTH
    tree = culling.tree
    nodes = tree.nodes
    ends = [(nodes.begin_low.numpy(), nodes.begin_high.numpy()), (nodes.end_low.numpy(), nodes.end_high.numpy())]
    for low, high in ends:
        for node in range(1, tree.leaves):
            for child in (2 * node, 2 * node + 1):
                assert np.all(low[node] <= low[child])
                assert np.all(high[node] >= high[child])
    for p in range(culling.count):
        for starts, members in zip(culling.starts, skin.members, strict=True):
            for x, (low, high) in zip((x0, x1), ends, strict=True):
                own = x[members[starts[p] : starts[p + 1]].ravel()]
                assert np.all(own >= low[tree.leaves + p])
                assert np.all(own <= high[tree.leaves + p])
    numbers = culling.statistics()
    assert numbers["inside"] + numbers["between"] == sum(map(len, pairs))
    moving = [not tree.obstacle.numpy()[p] for p in range(culling.count)]

    def meet(p, q):
        above = np.all([low[tree.leaves + p] > high[tree.leaves + q] for low, high in ends], axis=0)
        below = np.all([high[tree.leaves + p] < low[tree.leaves + q] for low, high in ends], axis=0)
        return not np.any(above | below)

    overlapping = sum(meet(p, q) and (moving[p] or moving[q]) for p in range(culling.count) for q in range(p))
    assert numbers["overlapping"] == overlapping


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("name", ["rod-twist", "cloth-ball", "n-body-simulation"])
def test_published_frames(name, method):
    """Every pair that the source of the frame lists as a hit is a candidate."""
    frame = np.load(data.path(f"ccd_frames/{name}.npz"))
    x0, x1, faces = frame["V0"], frame["V1"], frame["F"]
    n = len(x0)
    skin, _, (vertex_triangle, edge_edge) = search(
        method, "float64", x0, faces, np.zeros(n, int), np.zeros(n, bool), x0, x1, np.zeros(n)
    )
    # the source numbers vertices, then edges by their later and then their earlier end, then faces
    edges = surface.unique_edges(faces)
    edges = edges[np.lexsort((edges[:, 0], edges[:, 1]))]
    vertices, own_edges, own_faces = skin.members
    i, j = (places(edges[own - n], own_edges) for own in frame["pair_ee"][frame["hit_ee"]].T)
    apart = (own_edges[i][:, :, None] != own_edges[j][:, None, :]).all(axis=(1, 2))
    all_listed(np.minimum(i, j)[apart], np.maximum(i, j)[apart], *edge_edge.T)
    v, t = (frame["pair_vf"][frame["hit_vf"]] - [0, n + len(edges)]).T
    apart_too = (faces[t] != v[:, None]).all(axis=1)
    v, t = places(v[apart_too, None], vertices), places(faces[t[apart_too]], own_faces)
    position = np.zeros(n, dtype=int)
    position[vertices[:, 0]] = np.arange(len(vertices))
    all_listed(v, t, position[vertex_triangle[:, 0]], vertex_triangle[:, 1])
    assert len(v) + apart.sum() > 50


def places(rows, table):
    """(k,) where each row of vertices is in a table that holds it."""

    def keys(a):
        return np.ravel_multi_index(tuple(a.T.astype(np.int64)), (table.max() + 1,) * table.shape[1])

    order = np.argsort(keys(table))
    found = order[np.searchsorted(keys(table)[order], keys(rows))]
    assert np.array_equal(table[found], rows)
    return found


def all_listed(first, second, listed_first, listed_second):
    """Every pair is in the list, which ascends by its first, then its second."""
    wanted, listed = (a.astype(np.int64) << 31 | b for a, b in ((first, second), (listed_first, listed_second)))
    assert np.all(np.diff(listed) > 0)
    assert np.array_equal(listed[np.minimum(np.searchsorted(listed, wanted), len(listed) - 1)], wanted)
