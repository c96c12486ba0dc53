"""Box overlap against brute force, with sizes over many orders of magnitude and with boxes that only touch."""

import numpy as np
import pytest

from pdipc.judge import boxes


def random_boxes(rng: np.random.Generator, count: int, on_grid: bool) -> tuple[np.ndarray, np.ndarray]:
    if on_grid:
        low = rng.integers(-5, 5, (count, 3)) * 0.25
        return low, low + rng.integers(0, 4, (count, 3)) * 0.25
    low = rng.normal(size=(count, 3))
    return low, low + np.exp(rng.normal(-2, 2, (count, 1))) * rng.random((count, 3))


def meet(low_a, high_a, low_b, high_b) -> bool:
    return all(a <= d and c <= b for a, b, c, d in zip(low_a, high_a, low_b, high_b, strict=True))


@pytest.mark.parametrize("few", [0, boxes.FEW])
@pytest.mark.parametrize("on_grid", [False, True])
@pytest.mark.parametrize("seed", range(20))
def test_overlapping_is_brute_force(seed, on_grid, few, monkeypatch):
    monkeypatch.setattr(boxes, "FEW", few)
    rng = np.random.default_rng(seed)
    (low_a, high_a), (low_b, high_b) = (random_boxes(rng, count, on_grid) for count in rng.integers(1, 60, 2))
    pairs = boxes.overlapping(low_a, high_a, low_b, high_b)
    expected = [(i, j) for i in range(len(low_a)) for j in range(len(low_b)) if meet(low_a[i], high_a[i], low_b[j], high_b[j])]
    assert sorted(map(tuple, pairs.tolist())) == expected


def test_one_huge_box_among_many_small_ones():
    low = np.random.default_rng(0).random((100_000, 3))
    pairs = boxes.overlapping(low, low + 1e-3, np.array([[-1e3] * 3]), np.array([[0.5] * 3]))
    assert set(pairs[:, 0]) == set(np.flatnonzero(np.all(low <= 0.5, axis=1)))


def test_parts_are_bounded_however_many_pairs_there_are():
    """Every box meets every other one."""
    low = np.random.default_rng(2).uniform(0.0, 1.0, (1500, 3))
    count = 0
    for part in boxes.parts(low, low + 2.0, low, low + 2.0):
        assert len(part) <= boxes.PART + len(low)
        count += len(part)
    assert count == len(low) ** 2
