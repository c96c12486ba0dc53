"""Hunts for a wrong "cannot meet": `python benchmarks/rejections.py [--pairs N] [--seed S] [--minutes M]`.

Asks whatever in the package leaves pairs out about pairs of every family in tests/collision/hard_queries.py, both kinds, float64 and
float32, at reaches of any size and at such as a pair just keeps or just misses. What is left out is judged by
tests/collision/exact.py, which proves it with a margin far above its rounding, or decides it in whole numbers.

- sieve, boxes, ccd, cubic and directions: pair by pair, see tests/collision/rejections.py;
- patches, bvh: what whole lists leave out of soups of triangles (trees, patches, boxes and the sieve together);
- near: what counts as near enough to use a list again;
- judge's boxes, judge's filter: what the witness leaves out (judge/boxes.py), and decides, mostly without whole numbers (judge/witness.py).

It must end with "wrong: 0". Writes benchmarks/results/rejections.json.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(REPOSITORY / "tests"), str(REPOSITORY / "benchmarks")]

from ccd import machine  # noqa: E402
from collision import hard_queries, rejections  # noqa: E402

from pdipc.judge import boxes  # noqa: E402

FAMILIES = hard_queries.FAMILIES + hard_queries.CULLING
BATCH = 20_000  # pairs of one family, kind and precision asked about at a time
SOUPS = 8  # of each family, precision and culling in one round
STRAYS = 150_000  # of each precision in one round
MOTIONS = 80  # of each family and precision, for the judge's boxes
SEGMENTS = 20_000  # of each family and precision, for the judge's filter


class Count:
    """asked: pairs. left_out: of those. wrong: of those."""

    def __init__(self):
        self.asked = self.left_out = self.wrong = 0

    def add(self, asked: int, left_out: int, wrong: int) -> None:
        self.asked, self.left_out, self.wrong = self.asked + int(asked), self.left_out + int(left_out), self.wrong + int(wrong)


def ask_pairs(rng, counts, report) -> None:
    for family in FAMILIES:
        for precision in rejections.PRECISIONS:
            for kind in rejections.KINDS:
                points, reach = rejections.pairs(family, kind, precision, BATCH, rng)
                left_out = {name: ask(points, kind, precision, reach) for name, ask in rejections.REJECTIONS.items()}
                wrong = rejections.wrong(points, kind, reach, np.logical_or.reduce([*left_out.values()]))
                for name, rejected in left_out.items():
                    counts[name].add(len(points), rejected.sum(), rejected[wrong].sum())
                for i in wrong:
                    report([name for name in left_out if left_out[name][i]], family, precision, kind, points[i], reach[i])


def ask_lists(rng, counts, report) -> None:
    for precision in rejections.PRECISIONS:
        for method in ("patches", "bvh"):
            left_out = {kind: [] for kind in rejections.KINDS}
            for number in range(SOUPS * len(FAMILIES)):
                *mesh, reach = rejections.soup(FAMILIES[number % len(FAMILIES)], precision, rng)
                for kind, (points, asked) in zip(
                    rejections.KINDS, rejections.unlisted(*mesh, reach, precision, method), strict=True
                ):
                    counts[method].add(asked, len(points), 0)
                    left_out[kind].append((points, np.full(len(points), reach), np.full(len(points), number)))
            for kind, of_soups in left_out.items():  # judged together, which is most of the work, in a third of the time
                points, reaches, numbers = (np.concatenate(parts) for parts in zip(*of_soups, strict=True))
                wrong = rejections.wrong(points, kind, reaches, np.ones(len(points), dtype=bool))
                counts[method].add(0, 0, len(wrong))
                for i in wrong:
                    report(method, FAMILIES[numbers[i] % len(FAMILIES)], precision, kind, points[i], reaches[i])


def ask_near(rng, counts, report) -> None:
    for precision in rejections.PRECISIONS:
        x, y, margin = rejections.strays(precision, STRAYS, rng)
        near = rejections.is_near(x, y, margin, precision)
        wrong = rejections.not_near(x, y, margin, near)
        counts["near"].add(len(x), near.sum(), len(wrong))
        for i in wrong:
            report("near", None, precision, "", np.stack([x[i], y[i]]), margin[i])


def ask_judge(rng, counts, report) -> None:
    """Edges and triangles at the start of a query: boxes that the witness leaves out, against all of them."""
    for family in FAMILIES:
        for precision in rejections.PRECISIONS:
            x, _, triangles, _ = rejections.soup(family, precision, rng, MOTIONS)
            if len(x) == 0:
                continue
            edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
            ends, corners = x[edges], x[triangles]
            overlapping = boxes.overlapping(ends.min(axis=1), ends.max(axis=1), corners.min(axis=1), corners.max(axis=1))
            met = np.all(
                (ends.min(axis=1)[:, None] <= corners.max(axis=1)) & (ends.max(axis=1)[:, None] >= corners.min(axis=1)), axis=2
            )
            found = np.zeros_like(met)
            found[overlapping[:, 0], overlapping[:, 1]] = True
            counts["judge's boxes"].add(met.size, (~found).sum(), (met & ~found).sum())


def ask_filter(rng, counts, report) -> None:
    """Segments and triangles: what the witness says, mostly without whole numbers."""
    for family in FAMILIES:
        for precision in rejections.PRECISIONS:
            points = rejections.segments(family, precision, rng, SEGMENTS)
            said = rejections.crossing(points)
            wrong = rejections.wrongly_crossing(points, said)
            counts["judge's filter"].add(len(points), (~said).sum(), len(wrong))
            for i in wrong:
                report("judge's filter", family, precision, "", points[i], 0.0)


# what is asked until each has been asked often enough
QUESTIONS = {
    ask_pairs: tuple(rejections.REJECTIONS),
    ask_lists: ("patches", "bvh"),
    ask_near: ("near",),
    ask_judge: ("judge's boxes",),
    ask_filter: ("judge's filter",),
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pairs", type=int, default=10_000_000, help="pairs that each rejection is asked about")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=60.0, help="ends after this time, however many were asked")
    parser.add_argument("--output", type=Path, default=REPOSITORY / "benchmarks" / "results" / "rejections.json")
    options = parser.parse_args()
    counts, examples = defaultdict(Count), []

    def report(name, family, precision, kind, points, reach) -> None:
        examples.append([name, getattr(family, "__name__", ""), precision, kind, np.asarray(points).tolist(), float(reach)])
        print("WRONG", *examples[-1], flush=True)

    commit = subprocess.run(
        ["git", "rev-parse", "HEAD"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    ).stdout.strip()
    begun, seconds, rounds, least = time.perf_counter(), 0.0, 0, 0
    while least < options.pairs and seconds < 60 * options.minutes:
        for number, (ask, names) in enumerate(QUESTIONS.items()):
            if min(counts[name].asked for name in names) < options.pairs:
                ask(np.random.default_rng([options.seed, rounds, number]), counts, report)
        rounds += 1
        culling = [counts[name].asked for names in QUESTIONS.values() for name in names]
        least, seconds = min(culling), time.perf_counter() - begun
        wrong = sum(count.wrong for count in counts.values())
        print(f"{sum(culling):,} questions, {least:,} or more of each kind, in {seconds:.0f} s, wrong: {wrong}", flush=True)
        rows = {name: vars(count) for name, count in counts.items()}
        head = {"machine": machine(), "load": os.getloadavg()[1], "commit": commit, "seed": options.seed, "rounds": rounds}
        result = head | {"seconds": round(seconds), "pairs": sum(culling), "of": rows, "examples": examples[:20]}
        options.output.write_text(json.dumps(result, indent=1) + "\n")
    for name, row in rows.items():
        print(f"{name:22} {row['asked']:12,} asked {row['left_out']:12,} left out {row['wrong']:6} wrong")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
