"""One command for a machine with a GPU: checks CUDA against the CPU, then times it: `python benchmarks/gpu.py [-o FOLDER]`.

It needs a checkout and the package's own dependencies; the package need not be installed. Parts by name (--only), in order of worth: bundled
scenes step on CUDA as on the CPU, with the same bits again, and without intersections (`scenes`); kernels against the CPU (`kernels`,
`ccd`) and solvers against SciPy (`solvers`); then times of the peers' scenes, of the bundled ones, of Table 1, of CCD and of the solvers
(Fig. 8), and each kernel's own.

A machine that is lent for minutes should neither compile nor compute references: `--prepare FOLDER --arch 90` does both where there is
no GPU, and `--carried FOLDER` uses them there. No Warp compiler for the CPU is needed then.

Results are lines of gpu.jsonl, written as they come, and at the end gpu.json. Each part is a process of its own with a limit of time
for each of its cases: what breaks or hangs is told with its traceback, and the part goes on with the next case in a new process.

Exit code 0: all is well; 1: a check failed or a case broke; 2: no CUDA device. `--device cpu --small` tries the command itself.
"""

import argparse
import datetime
import faulthandler
import json
import os
import platform
import subprocess
import sys
import time
import traceback
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import warp as wp

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(REPOSITORY / folder) for folder in ("src", ".", "benchmarks", "tests/collision")]

import gpu_checks as checks  # noqa: E402
import gpu_predict as predict  # noqa: E402
import gpu_times as times  # noqa: E402

from pdipc.device.launch import Device  # noqa: E402

BUDGET = 6 * 60  # s
START = 20.0  # s that a process may take to begin
GRACE = 5.0  # s that a case may take longer than its limit before its process is ended


class Report:
    """Rows and checks of one case, appended to a file of JSON lines as they come. seconds: what the case may take."""

    def __init__(self, path: Path, part: str, case: str, seconds: float):
        self.path, self.of, self.begun, self.seconds = path, {"part": part, "case": case}, time.perf_counter(), seconds

    def left(self) -> float:
        """Seconds that are left to the case."""
        return self.seconds - (time.perf_counter() - self.begun)

    def check(self, name: str, found: float, limit: float) -> None:
        """A number that must not be larger than its limit; not a number fails."""
        passed = bool(found <= limit)
        print(f"  {'ok  ' if passed else 'FAIL'} {self.of['case']}: {name}: {found:.3g} (at most {limit:g})", flush=True)
        self.add(check=name, found=float(found), limit=limit, passed=passed)

    def add(self, **row) -> None:
        """A line of the part's results."""
        line = json.dumps(self.of | row) + "\n"
        with self.path.open("a") as file:  # one write: other processes append to it, too
            file.write(line)


@dataclass(frozen=True)
class Part:
    """run(report, device, case, carried) does one of `cases(small)`. seconds: what a case may take. together: whether cases may share
    the GPU, as those may that time nothing."""

    run: Callable[[Report, Device, str, Path | None], None]
    cases: Callable[[bool], list[str]]
    seconds: float
    together: bool = False


PARTS = {
    "scenes": Part(checks.check_scene, checks.scene_cases, 45, together=True),
    "kernels": Part(checks.check_kernels, checks.precisions, 30, together=True),
    "ccd": Part(checks.check_ccd, checks.precisions, 30, together=True),
    "solvers": Part(checks.check_solver, checks.solver_cases, 30, together=True),
    "worlds": Part(checks.check_worlds, checks.world_cases, 20),
    "peer scenes": Part(times.time_scene, times.peer_cases, 25),
    "bundled scenes": Part(times.time_scene, times.bundled_cases, 15),
    "paper scenes": Part(times.time_scene, times.paper_cases, 25),
    "ccd times": Part(times.time_ccd, times.ccd_cases, 20),
    "sweeps": Part(times.time_sweeps, times.sweep_cases, 40),
    "profile": Part(times.profile, times.profile_cases, 30),
}


def run_cases(part: str, cases: list[str], options: argparse.Namespace, out: Path) -> None:
    """Cases of a part, in this process, which ends with all its tracebacks where one takes too long."""
    place, end, most = Device(options.device), time.perf_counter() + options.seconds, options.limit or np.inf
    for case in cases:
        limit = min(PARTS[part].seconds, most, end - time.perf_counter())
        report = Report(out, part, case, limit)
        if limit < 3:
            report.add(skipped="no time left")
            continue
        report.add(begun=True)
        faulthandler.dump_traceback_later(limit + GRACE, exit=True)
        try:
            PARTS[part].run(report, place, case, options.carried)
            wp.synchronize()
        except Exception as error:
            traceback.print_exc()
            report.add(broken=f"{type(error).__name__}: {error}")
            sys.stdout.flush()
            os._exit(1)  # after some errors of CUDA nothing works any more in a process, not even its end
        finally:
            faulthandler.cancel_dump_traceback_later()
        report.add(ended=True, seconds=limit - report.left())


def start_cases(part: str, cases: list[str], options: argparse.Namespace, seconds: float) -> str:
    """Cases of a part in processes of their own; what they print. A process that ends early is followed by one for the cases after."""
    printed, end = "", time.perf_counter() + seconds
    while cases and end - time.perf_counter() > 3:
        left = end - time.perf_counter()
        command = [
            sys.executable,
            "-X",
            "faulthandler",
            __file__,
            "--part",
            part,
            "--cases",
            json.dumps(cases),
            "--device",
            options.device,
        ]
        command += ["--seconds", str(left), "-o", str(options.output)]
        command += ["--carried", str(options.carried)] if options.carried else []
        command += ["--limit", str(options.limit)] if options.limit else []
        try:
            done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=left + START)
            printed, error = printed + done.stdout, f"its process ended with code {done.returncode}"
        except subprocess.TimeoutExpired as late:
            out = late.stdout or b""
            printed, error = printed + (out.decode() if isinstance(out, bytes) else out), "its process did not end in time"
        lines = [line for line in read(options.output / "gpu.jsonl") if line["part"] == part]
        over = {line["case"] for line in lines if "ended" in line or "broken" in line or "skipped" in line}
        begun = {line["case"] for line in lines if "begun" in line}
        rest = [case for case in cases if case not in over]
        if not rest:
            return printed
        stuck = [case for case in rest if case in begun] or (rest[:1] if len(rest) == len(cases) else [])
        for case in stuck:
            Report(options.output / "gpu.jsonl", part, case, 0.0).add(broken=error)
            printed += f"  BROKEN {case}: {error}\n"
        cases = [case for case in rest if case not in stuck]
    for case in cases:
        Report(options.output / "gpu.jsonl", part, case, 0.0).add(skipped="no time left")
    return printed


def read(path: Path) -> list[dict]:
    """The lines so far."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def sound(lines: list[dict]) -> bool:
    """Whether every check passed and nothing broke."""
    return not any("broken" in line or line.get("passed") is False for line in lines)


def describe(place: Device) -> dict:
    """The machine and what runs on it."""
    found = {"device": place.warp.name, "host": platform.platform(), "python": platform.python_version()}
    found |= {
        "warp": wp.config.version,
        "numpy": np.__version__,
        "date": datetime.date.today().isoformat(),
        "cores": os.cpu_count(),
    }
    if place.is_cuda:
        query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,clocks.sm,clocks.max.sm", "--format=csv,noheader"]
        try:
            found["nvidia-smi"] = subprocess.run(query, capture_output=True, text=True, check=True).stdout.strip()
        except (OSError, subprocess.CalledProcessError) as error:
            found["nvidia-smi"] = f"did not answer: {error}"
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", help='absent: the first CUDA device; "cpu" only tries the command')
    parser.add_argument("--small", action="store_true", help="few and small cases")
    parser.add_argument("-o", "--output", type=Path, default=REPOSITORY / "results" / "gpu", help="absent: results/gpu")
    parser.add_argument("--only", nargs="+", choices=PARTS, metavar="PART", help=f"some parts: {', '.join(PARTS)}")
    parser.add_argument("--case", default="", help='only the cases whose name contains this, or one of these: "this|that"')
    parser.add_argument("--seconds", type=float, default=BUDGET, help=f"absent: {BUDGET}")
    parser.add_argument("--limit", type=float, help="most seconds a case; absent: as each part says")
    parser.add_argument(
        "--jobs", type=int, default=min(6, max(1, (os.cpu_count() or 1) // 2)), help="processes of checks at once"
    )
    parser.add_argument("--carried", type=Path, help="what --prepare wrote")
    parser.add_argument("--prepare", type=Path, help="a folder for references of the CPU and, with --arch, compiled kernels")
    parser.add_argument(
        "--arch", type=int, help="90 for an H100; the kernels' cache is then FOLDER/kernels, for WARP_CACHE_PATH"
    )
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--cases", type=json.loads, help=argparse.SUPPRESS)
    parser.add_argument(
        "--predict", action="store_true", help="what the peers' scenes and Table 1's should take, without a GPU"
    )
    options = parser.parse_args(arguments)
    if options.predict:
        predict.print_table()
        return 0
    if options.prepare:
        checks.prepare(options.prepare, options.arch, options.small, options.case)
        return 0
    wp.init()
    if options.device is None and not wp.is_cuda_available():
        print("no CUDA device was found; to try this command without one: --device cpu --small", file=sys.stderr)
        return 2
    options.device = options.device or "cuda:0"
    options.output.mkdir(parents=True, exist_ok=True)
    lines = options.output / "gpu.jsonl"
    if options.part:
        run_cases(options.part, options.cases, options, lines)
        return 0
    begun = time.perf_counter()
    machine = describe(Device(options.device))
    print(", ".join(str(value) for value in machine.values()), flush=True)
    lines.unlink(missing_ok=True)
    for name in options.only or PARTS:
        part, left = PARTS[name], options.seconds - (time.perf_counter() - begun)
        cases = [case for case in part.cases(options.small) if checks.chosen(options.case, case)]
        jobs = min(options.jobs, len(cases)) if part.together else 1
        print(f"{name}: {len(cases)} cases  [{left:.0f} s left]", flush=True)
        with ThreadPoolExecutor(max(1, jobs)) as pool:
            shares = [cases[job::jobs] for job in range(jobs)]
            for printed in pool.map(
                lambda share, name=name, left=left: start_cases(name, share, options, left - START), shares
            ):
                print(printed, end="", flush=True)
        found = read(lines)
        told = {"machine": machine, "small": options.small, "seconds": time.perf_counter() - begun, "ok": sound(found)}
        results = [line for line in found if "begun" not in line]
        text = ",\n".join(json.dumps(line) for line in results)
        (options.output / "gpu.json").write_text(json.dumps(told, indent=1)[:-2] + f',\n "results": [\n{text}\n]}}\n')
    failed = [line for line in found if line.get("passed") is False]
    broken = [line for line in found if "broken" in line]
    skipped = [line for line in found if "skipped" in line]
    for line in [*broken, *failed]:
        print("  ", json.dumps(line))
    count = sum("check" in line for line in found)
    print(
        f"{count} checks, {len(failed)} failed, {len(broken)} broken, {len(skipped)} skipped; {time.perf_counter() - begun:.0f} s"
    )
    return 0 if sound(found) else 1


if __name__ == "__main__":
    sys.exit(main())
