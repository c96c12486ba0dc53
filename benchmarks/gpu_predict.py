"""What a step should take on a GPU, from its launches and the bytes they touch: `benchmarks/gpu.py --predict`. No GPU is needed.

A scene is built as for CUDA, and Algorithm 1 is gone through without running a kernel: every launch is noted with the loop that it is
in, and with the bytes of the arrays that it is given, each once. How often loops turn is taken from a measured run. Then

    a step = launches x LAUNCH + turns x TURN + bytes / bandwidth.

That is a model to be refuted: it knows no cache (what stays in it makes steps faster), no uneven work and no thread that waits for many reads
one after another (which make them slower).
"""

import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import peer_scenes
import warp as wp

import pdipc
from pdipc import algorithm
from pdipc.device.launch import BLOCK, CUDA_BLOCK, Device
from pdipc.linear.wide_pcg import TURN as ITERATIONS
from pdipc.work import Work

LAUNCH = 3.0e-6  # s of a kernel in a graph that waits for the one before, and does next to nothing
LOOP_TURN = 5.1e-6  # s, measured on an H100
MACHINES = {"H100": 2.958e12, "RTX 3090": 0.94e12}  # bytes/s: a copy's, measured; the paper's GPU, from its data sheet
MEMORY = 80.0e9  # bytes
MEASURED = Path(__file__).parent / "results" / "gpu.json"


class Tracer(Device):
    """Runs nothing. launches: by the conditions of the loops and branches that they are in, bytes of each launch of one turn."""

    def __init__(self):
        super().__init__("cpu", threads=1)
        self.wide, self.block = True, CUDA_BLOCK
        self.launches: dict[tuple[int, ...], list[int]] = defaultdict(list)
        self._inside: tuple[int, ...] = ()

    def _note(self, inputs: Sequence[Any]) -> None:
        arrays = {each.ptr: each.size * wp.types.type_size_in_bytes(each.dtype) for each in _arrays(inputs)}
        self.launches[self._inside].append(sum(arrays.values()))

    def launch(self, kernel, dim, inputs, grain=1):
        self._note(inputs)

    def launch_blocks(self, kernel, blocks, inputs, grain=BLOCK):
        self._note(inputs)

    def launch_list(self, kernel, capacity, inputs):
        self._note(inputs)

    launch_scatter = launch_list

    def launch_serial(self, kernel, inputs):
        self._note(inputs)

    def copy(self, destination, source):
        self._note([destination, source])

    def once(self, operation: Callable[[], None]) -> None:
        self._note([])

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


def predict(name: str, row: dict) -> dict:
    """row: what was measured of the scene: outer and linear iterations, truncations, barriers, mean milliseconds."""
    place = Tracer()
    model = pdipc.build(peer_scenes.scene(name, precision="float32"), place)
    work = Work(model, recorded=False)
    while work.method.pairs.capacity < row["barriers"]:
        work.method.pairs.count.assign([0, int(row["barriers"]), 0])
        work.method.grow()
    place.launches.clear()
    algorithm.time_step(work)
    method, outer, going = work.method, row["outer"], work.going.ptr
    conjugate = (going, method.solver._going.ptr)
    turns = {
        (): 1.0,
        (going,): outer,
        (going, method.renew.ptr): outer,
        conjugate: row["linear_iterations"] / ITERATIONS,
        (going, work.truncation.going.ptr): outer + row["truncations"],
        (going, work.truncation.going.ptr, work.truncation.any_hit.ptr): row["truncations"],
        (going, work.candidates.needed.ptr): 1.0,  # a list lasts for about a step
    }
    launches = sum(number * len(place.launches[key]) for key, number in turns.items())
    moved = sum(number * sum(place.launches[key]) for key, number in turns.items())
    waits = launches * LAUNCH + sum(turns.values()) * LOOP_TURN
    memory = memory_of(work)
    return {
        "scene": name,
        "DOF": 3 * model.vertex_count,
        "launches": launches,
        "an iteration": len(place.launches[conjugate]) / ITERATIONS,
        "GB": moved / 1e9,
        "waits ms": 1e3 * waits,
        **{machine: 1e3 * (waits + moved / speed) for machine, speed in MACHINES.items()},
        "measured": row["mean ms"],
        "MB": memory / 1e6,
        "largest": 3 * model.vertex_count * MEMORY / memory,
        "limit": "waiting" if waits > moved / MACHINES["H100"] else "bytes",
    }


def print_table() -> None:
    measured = {
        row["case"]: row
        for row in json.loads(MEASURED.read_text())["results"]
        if row.get("part") == "peer scenes" and "outer" in row
    }
    print(
        "| scene | DOF | launches | GB moved | ms, H100 | ms, RTX 3090 | measured, H100 | limit | memory, MB | DOF in 80 GB |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |")
    for name in peer_scenes.SCENES:
        if name in measured:
            r = predict(name, measured[name])
            print(
                f"| {name} | {r['DOF']:,} | {r['launches']:,.0f} | {r['GB']:.2f} | {r['H100']:.1f} | {r['RTX 3090']:.1f} | {r['measured']:.1f} | "
                f"{r['limit']} | {r['MB']:.0f} | {r['largest'] / 1e6:.0f} M |",
                flush=True,
            )
