"""What a step should take on a GPU, from its launches and the bytes they touch: `benchmarks/gpu.py --predict`. No GPU is needed.

A scene is built as for CUDA, and Algorithm 1 is gone through without running a kernel: every launch is noted with the loop that it is
in, with its threads, and with the bytes of the arrays that it is given, each once. How often loops turn is taken from a measured run. Then

    a step = sum over launches of (LAUNCH + max(bytes / bandwidth, reads of a thread x LATENCY)) + turns x LOOP_TURN.

A thread reads its share of the arrays, up to 16 bytes at a time, and one read waits for the other, as reads through an index do: few threads do not
fill the memory's pipes, however fast it is. That is a model to be refuted: it knows no cache (what stays in it makes steps faster), no reads
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
    """A kernel's name, the bytes of its arrays, and how many reads a thread makes of them."""

    kernel: str
    bytes: int
    reads: int

    def seconds(self, bandwidth: float) -> float:
        return LAUNCH + max(self.bytes / bandwidth, self.reads * LATENCY)


class Tracer(Device):
    """Runs nothing. launches: by the conditions of the loops and branches that they are in, those of one turn."""

    def __init__(self):
        super().__init__("cpu", threads=1)
        self.wide, self.block = True, CUDA_BLOCK
        self.launches: dict[tuple[int, ...], list[Launch]] = defaultdict(list)
        self._inside: tuple[int, ...] = ()

    def _note(self, name: str, threads: int, inputs: Sequence[Any], shared: bool = False) -> None:
        """shared: whether the threads share the arrays out; else each has an index, and rows of a few entries."""
        arrays = {each.ptr: (each.size, wp.types.type_size_in_bytes(each.dtype)) for each in _arrays(inputs)}
        moved = sum(count * width for count, width in arrays.values())
        reads = 0
        for count, width in arrays.values():
            own = -(-count // threads)
            reads += (own if shared or own <= ROW else 1) * -(-width // WORD)
        self.launches[self._inside].append(Launch(name, moved, reads))

    def launch(self, kernel, dim, inputs, grain=1):
        self._note(kernel.key, dim, inputs)

    def launch_blocks(self, kernel, blocks, inputs, grain=BLOCK):
        self._note(kernel.key, BLOCK * blocks, inputs, shared=True)

    def launch_list(self, kernel, capacity, inputs):
        self._note(kernel.key, min(capacity, CUDA_WORKERS), inputs, shared=True)

    launch_scatter = launch_list

    def launch_serial(self, kernel, inputs):
        self._note(kernel.key, 1, inputs)

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
    place.launches.clear()
    algorithm.time_step(work)
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
    return {
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


HEADER = (
    "| scene | DOF | launches | GB moved | ms, H100 | ms, RTX 3090 | measured, H100 | measured / predicted | the paper's, RTX 3090 | memory, MB | DOF in 80 GB |",
    "| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |",
)
PAPER_STAGES = slice(COLUMNS.index("solver ms"), COLUMNS.index("misc ms") + 1)


def print_table(names: Sequence[str] = ()) -> None:
    """Of the peers' scenes, and of Table 1's rows at the paper's size, whose own milliseconds stand beside; all that were measured or those named."""
    measured = {(row["part"], row["case"]): row for row in json.loads(MEASURED.read_text())["results"] if "outer" in row}
    print("\n".join(HEADER))
    for part, name in ORDER:
        if (part, name) not in measured or (names and name not in names):
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
