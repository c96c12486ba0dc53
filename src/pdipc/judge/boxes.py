"""Which axis-aligned boxes overlap, in NumPy: for checks before and after a simulation, not for the simulation itself."""

import itertools
from collections.abc import Iterator

import numpy as np

PART = 1 << 17  # pairs, and places where pairs may be, that are looked at together
FEW = 1 << 16  # pairs; so many are sooner compared than sorted into grids


def overlapping(low_a: np.ndarray, high_a: np.ndarray, low_b: np.ndarray, high_b: np.ndarray) -> np.ndarray:
    """All (i, j) for which closed box i of a and box j of b share a point: (k, 2) int64, in no particular order.

    low and high: (n, 3) corners, at most 1e300 in size.
    """
    return np.concatenate([np.zeros((0, 2), dtype=np.int64), *parts(low_a, high_a, low_b, high_b)])


def parts(low_a: np.ndarray, high_a: np.ndarray, low_b: np.ndarray, high_b: np.ndarray) -> Iterator[np.ndarray]:
    """What `overlapping` returns, in parts of about PART pairs at most, so that memory does not grow with their number.

    Few boxes are compared each with each. For more, a hierarchy of grids: each box lives in the grid whose cells are just larger than it, so that it touches at most eight; a pair meets
    in the coarser grid of the two.

    Exact: corners are only compared. Cell numbers round, but are monotone in the coordinate: the greater of two low corners, in each
    coordinate, is a point of both boxes of a pair that meets, and its cell is between the first and the last of both. A box is at most
    a cell wide, less 1e-9 of it, and there are at most 2^18 cells, where a number rounds by 6e-11: so it reaches from its first cell
    to the next one at most.
    """
    if len(low_a) == 0 or len(low_b) == 0:
        return
    low_a, high_a, low_b, high_b = (np.asarray(corner, dtype=np.float64) for corner in (low_a, high_a, low_b, high_b))
    if len(low_a) * len(low_b) <= FEW:
        yield np.argwhere(np.all((low_a[:, None] <= high_b) & (low_b <= high_a[:, None]), axis=2))
        return
    origin = np.minimum(low_a.min(axis=0), low_b.min(axis=0))
    extent = max(high_a.max(axis=0).max(), high_b.max(axis=0).max()) - origin.min()
    finest = max(extent * 2.0**-18, np.finfo(np.float64).tiny)  # so that three cell numbers fit into one key

    def levels(low: np.ndarray, high: np.ndarray) -> np.ndarray:
        return np.ceil(np.log2(np.maximum((high - low).max(axis=1), finest) / finest)).astype(np.int64)

    level_a, level_b = levels(low_a, high_a), levels(low_b, high_b)
    for level in np.union1d(level_a, level_b):
        size = finest * 2.0**level * (1 + 1e-9)  # rounding must not let a box reach a third cell
        own_a, own_b = level_a == level, level_b == level
        upto_a = level_a <= level
        below_b = level_b < level
        for in_a, in_b in ((upto_a, own_b), (own_a, below_b)):
            a, b = np.flatnonzero(in_a), np.flatnonzero(in_b)
            if len(a) and len(b):
                yield from _join(a, b, low_a, high_a, low_b, high_b, origin, size)


def _join(a, b, low_a, high_a, low_b, high_b, origin, size) -> Iterator[np.ndarray]:
    """Pairs of boxes a and b, each no larger than `size`, through a grid of that size."""
    a = a[np.all((low_a[a] <= high_b[b].max(axis=0)) & (high_a[a] >= low_b[b].min(axis=0)), axis=1)]

    def entries(chosen: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Every (cell key, box) in which a chosen box appears, in order of keys."""
        first = np.floor((low[chosen] - origin) / size).astype(np.int64)
        last = np.floor((high[chosen] - origin) / size).astype(np.int64)
        keys, boxes = [], []
        for corner in range(8):
            step = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
            reached = np.all(first + step <= last, axis=1)
            keys.append(_key(first[reached] + step))
            boxes.append(chosen[reached])
        keys, boxes = np.concatenate(keys), np.concatenate(boxes)
        order = np.argsort(keys, kind="stable")
        return keys[order], boxes[order]

    keys_a, boxes_a = entries(a, low_a, high_a)
    keys_b, boxes_b = entries(b, low_b, high_b)
    begin, end = np.searchsorted(keys_b, keys_a, "left"), np.searchsorted(keys_b, keys_a, "right")
    counts = end - begin
    columns = [np.ascontiguousarray(corner.T) for corner in (low_a, high_a, low_b, high_b)]
    for part in _parts(counts, PART):
        n = counts[part]
        rows = np.repeat(np.arange(part.start, part.stop), n)
        i = boxes_a[rows]
        j = boxes_b[np.arange(len(rows)) + np.repeat(begin[part] - np.cumsum(n) + n, n)]
        for axis in range(3):
            first_a, last_a, first_b, last_b = (corner[axis] for corner in columns)
            kept = np.flatnonzero((first_a[i] <= last_b[j]) & (first_b[j] <= last_a[i]))
            i, j, rows = i[kept], j[kept], rows[kept]
        # a pair that meets in several cells is taken from the one that holds the lower corner of its overlap
        here = _key(np.floor((np.maximum(low_a[i], low_b[j]) - origin) / size).astype(np.int64)) == keys_a[rows]
        yield np.column_stack([i[here], j[here]])


def _key(cells: np.ndarray) -> np.ndarray:
    return (cells[:, 0] << 42) + (cells[:, 1] << 21) + cells[:, 2]


def _parts(counts: np.ndarray, most: int) -> list[slice]:
    """Cuts a list into ranges of which each has about `most` entries in total."""
    ends = np.cumsum(counts)
    cuts = np.searchsorted(ends, np.arange(most, ends[-1], most)) + 1 if len(ends) else np.zeros(0, dtype=np.int64)
    bounds = np.unique(np.concatenate([[0], cuts, [len(counts)]]))
    return [slice(low, high) for low, high in itertools.pairwise(bounds)]
