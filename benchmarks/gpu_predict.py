"""What a step should take on a GPU, from its launches and the bytes they touch: `benchmarks/gpu.py --predict`. No GPU is needed.

A scene is built as for CUDA, and Algorithm 1 is gone through without running a kernel: every launch is noted with the loop that it is
in, with its threads, and with the bytes of the arrays that it is given, each once. How often loops turn is taken from a measured run. Then

    a step = sum over launches of (LAUNCH + max(bytes / bandwidth, reads of a thread x LATENCY)) + turns x LOOP_TURN.

A thread reads its share of the arrays, up to 16 bytes at a time, and one read waits for the other, as reads through an index do: few threads do not
fill the memory's pipes, however fast it is. Flops are counted as a multiplication and an addition for each floating-point number of these arrays. That is a model to be refuted: it knows no cache (what stays in it makes steps faster), no reads
that overlap, no whole arrays of which little is read (both likewise), and no work that is uneven among threads (which makes them slower).
"""

import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import peer_scenes
import warp as wp

import pdipc
from pdipc import algorithm
from pdipc.device.launch import BLOCK, CUDA_BLOCK, CUDA_WORKERS, Device
from pdipc.integration.status import STAGES
from pdipc.linear.wide_pcg import TURN as ITERATIONS
from pdipc.reproduce.table1 import COLUMNS, ROWS
from pdipc.work import Work

LAUNCH = 3.0e-6  # s of a kernel in a graph that waits for the one before, and does next to nothing
LOOP_TURN = 5.1e-6  # s, measured on an H100
MACHINES = {"H100": 2.958e12, "RTX 3090": 0.94e12}  # bytes/s: a copy's, measured; the paper's GPU, from its data sheet
LATENCY = 0.23e-6  # s of a read from memory: 400 cycles at 1755 MHz (H100; doi:10.1016/j.ultsonch.2023.106546, table 3)
ROW = 32  # entries at most of a thread's own row in an array; where its share would be more, it reads one
WORD = 16  # bytes, the most that a thread reads at once
MEMORY = 80.0e9  # bytes
ORDER = [*(("peer scenes", name) for name in peer_scenes.SCENES), *(("paper scenes", name) for name in ROWS)]
MEASURED = Path(__file__).parent / "results" / "gpu.json"


class Launch(NamedTuple):
    """A kernel's name, its stage, the bytes of its arrays, how many numbers they have, and how many reads a thread makes of them."""

    kernel: str
    stage: str
    bytes: int
    numbers: int
    reads: int

    def seconds(self, bandwidth: float) -> float:
        return LAUNCH + max(self.bytes / bandwidth, self.reads * LATENCY)

    def limit(self, bandwidth: float) -> str:
        """What most of its time goes to."""
        parts = {"launches": LAUNCH, "bandwidth": self.bytes / bandwidth, "latency": self.reads * LATENCY}
        return max(parts, key=parts.__getitem__)


class Tracer(Device):
    """Runs nothing. launches: by the conditions of the loops and branches that they are in, those of one turn."""

    def __init__(self):
        super().__init__("cpu", threads=1)
        self.wide, self.block = True, CUDA_BLOCK
        self.launches: dict[tuple[int, ...], list[Launch]] = defaultdict(list)
        self._inside: tuple[int, ...] = ()
        self._waiting: list[tuple[tuple[int, ...], Launch]] = []  # for the mark at the end of their stage

    def _note(self, name: str, threads: int, inputs: Sequence[Any], shared: bool = False) -> None:
        """shared: whether the threads share the arrays out; else each has an index, and rows of a few entries."""
        moved = numbers = reads = 0
        for each in {each.ptr: each for each in _arrays(inputs)}.values():
            width, own = wp.types.type_size_in_bytes(each.dtype), -(-each.size // threads)
            moved += each.size * width
            numbers += each.size * _numbers(each.dtype)
            reads += (own if shared or own <= ROW else 1) * -(-width // WORD)
        self._waiting.append((self._inside, Launch(name, "misc", moved, numbers, reads)))

    def conclude(self, stage: str) -> None:
        """All launches since the last time are of that stage."""
        for inside, launch in self._waiting:
            self.launches[inside].append(launch._replace(stage=stage))
        self._waiting = []

    def launch(self, kernel, dim, inputs, grain=1):
        self._note(kernel.key, dim, inputs)

    def launch_blocks(self, kernel, blocks, inputs, grain=BLOCK):
        self._note(kernel.key, BLOCK * blocks, inputs, shared=True)

    def launch_list(self, kernel, capacity, inputs):
        self._note(kernel.key, min(capacity, CUDA_WORKERS), inputs, shared=True)

    launch_scatter = launch_list

    def launch_serial(self, kernel, inputs):
        self._note(kernel.key, 1, inputs)
        if kernel.key.endswith("mark"):  # the clock's, at the end of a stage
            self.conclude(STAGES[inputs[0]])

    def copy(self, destination, source):
        self._note("copy", destination.size, [destination, source])

    def once(self, operation: Callable[[], None]) -> None:
        self._note("once", 1, [])

    def loop(self, condition: wp.array, body: Callable[[], None]) -> None:
        before, self._inside = self._inside, (*self._inside, condition.ptr)
        body()
        self._inside = before

    when = loop


def _arrays(inputs: Sequence[Any]):
    for each in inputs:
        if isinstance(each, wp.array):
            yield each
        elif hasattr(each, "_cls"):  # a struct
            yield from (value for value in vars(each).values() if isinstance(value, wp.array))


def _numbers(dtype: Any) -> int:
    """Floating-point numbers of an entry."""
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    floating = scalar in (wp.float32, wp.float64, float)
    return wp.types.type_size_in_bytes(dtype) // wp.types.type_size_in_bytes(scalar) if floating else 0


def memory_of(root: Any) -> int:
    """Bytes of all arrays that can be reached from an object of the package."""
    found, seen, left = {}, set(), [root]
    while left:
        each = left.pop()
        if id(each) in seen:
            continue
        seen.add(id(each))
        if isinstance(each, wp.array):
            found[each.ptr] = each.capacity
        elif isinstance(each, (list, tuple)):
            left += each
        elif isinstance(each, dict):
            left += each.values()
        elif type(each).__module__.startswith("pdipc."):
            left += vars(each).values()
    return sum(found.values())


def predict(name: str, scene: pdipc.Scene, row: dict) -> dict:
    """row: what was measured of the scene: outer and linear iterations, truncations, barriers, mean milliseconds."""
    place = Tracer()
    model = pdipc.build(scene, place)
    work = Work(model, recorded=False)
    while work.method.pairs.capacity < row["barriers"]:
        work.method.pairs.count.assign([0, int(row["barriers"]), 0])
        work.method.grow()
    place.conclude("misc")
    place.launches.clear()
    algorithm.time_step(work)
    place.conclude("misc")
    method, outer, going = work.method, row["outer"], work.going.ptr
    conjugate = (going, method.solver.condition.ptr)
    turns = {
        (): 1.0,
        (going,): outer,
        (going, method.renew.ptr): outer,
        conjugate: row["linear_iterations"] / ITERATIONS,
        (going, work.truncation.any_hit.ptr): row["truncations"],
        (going, work.candidates.needed.ptr): 1.0,  # a list lasts for about a step
    }
    launches = sum(number * len(place.launches[key]) for key, number in turns.items())
    moved = sum(number * sum(launch.bytes for launch in place.launches[key]) for key, number in turns.items())
    waits = sum(turns.values()) * LOOP_TURN

    def seconds(bandwidth: float) -> float:
        return waits + sum(
            number * sum(each.seconds(bandwidth) for each in place.launches[key]) for key, number in turns.items()
        )

    memory = memory_of(work)
    made = [(number, each) for key, number in turns.items() for each in place.launches[key]]
    return {
        "stages": {stage: _sum([(number, each) for number, each in made if each.stage == stage]) for stage in STAGES},
        "scene": name,
        "DOF": 3 * model.vertex_count,
        "launches": launches,
        "an iteration": len(place.launches[conjugate]) / ITERATIONS,
        "GB": moved / 1e9,
        "memory ms": 1e3 * moved / MACHINES["H100"],
        **{machine: 1e3 * seconds(speed) for machine, speed in MACHINES.items()},
        "measured": row["mean ms"],
        "MB": memory / 1e6,
        "largest": 3 * model.vertex_count * MEMORY / memory,
    }


def _sum(made: Sequence[tuple[float, Launch]]) -> dict:
    """How often each launch is made, and it."""
    fastest = MACHINES["H100"]
    limits: dict[str, float] = defaultdict(float)
    for number, each in made:
        limits[each.limit(fastest)] += number * each.seconds(fastest)
    return {
        "launches": sum(number for number, _ in made),
        "GB": 1e-9 * sum(number * each.bytes for number, each in made),
        "Gflop": 2e-9 * sum(number * each.numbers for number, each in made),
        "ms": 1e3 * sum(number * each.seconds(fastest) for number, each in made),
        "limit": max(limits, key=limits.__getitem__) if limits else "",
    }


HEADER = (
    "| scene | DOF | launches | GB moved | ms, H100 | ms, RTX 3090 | measured, H100 | measured / predicted | the paper's, RTX 3090 | memory, MB | DOF in 80 GB |",
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
)
PAPER_STAGES = slice(COLUMNS.index("solver ms"), COLUMNS.index("misc ms") + 1)


def print_table() -> None:
    """Of the peers' scenes, and of Table 1's rows at the paper's size, whose own milliseconds stand beside; all that were measured."""
    measured = {(row["part"], row["case"]): row for row in json.loads(MEASURED.read_text())["results"] if "outer" in row}
    print("\n".join(HEADER))
    stages = []
    for part, name in ORDER:
        if (part, name) not in measured:
            continue
        row = measured[part, name]
        paper = ROWS[name].paper if part == "paper scenes" else None
        try:
            scene = ROWS[name].full() if paper else peer_scenes.scene(name)
        except FileNotFoundError as error:  # optional data
            print(f"| {name} | {error} |", flush=True)
            continue
        scene = scene.model_copy(update={"simulation": scene.simulation.model_copy(update={"precision": "float32"})})
        r = predict(name, scene, row)
        theirs = f"{sum(map(float, paper[PAPER_STAGES])):.1f}" if paper else ""
        print(
            f"| {name} | {r['DOF']:,} | {r['launches']:,.0f} | {r['GB']:.2f} | {r['H100']:.1f} | {r['RTX 3090']:.1f} | {r['measured']:.1f} | "
            f"{r['measured'] / r['H100']:.1f} | {theirs} | {r['MB']:.0f} | {r['largest'] / 1e6:.0f} M |",
            flush=True,
        )
        cells = [
            f"{each['launches']:,.0f} / {each['GB']:.2f} / {each['Gflop']:.2f} / {each['ms']:.1f}, {each['limit']}"
            for each in r["stages"].values()
        ]
        stages.append(f"| {name} | {' | '.join(cells)} |")
    print("\nBy stage: launches / GB / Gflop / ms on an H100, and what most of that time goes to.\n")
    print(f"| scene | {' | '.join(STAGES)} |\n| --- {'| --- ' * len(STAGES)}|")
    print("\n".join(stages))
