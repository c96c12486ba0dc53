"""Files that other packages parse are read in a process of their own, within limits of time and memory.

Some parsers run forever on a damaged file, ask for memory without end, or end the process. Nothing of that reaches the caller: what
fails is a SceneError. One process reads all files of a scene, one after another, and is started when it is first needed.
"""

import io
import json
import os
import re
import subprocess
import sys
import threading
import time
from multiprocessing import spawn
from pathlib import Path
from typing import IO, Any

import numpy as np
import psutil

from pdipc.scene.errors import SceneError
from pdipc.scene.files import parse
from pdipc.scene.files.contents import Contents

START_SECONDS = 10.0  # until Python has started and NumPy is there
SECONDS, SECONDS_PER_MIB = 5.0, 1.0  # of work on a file: what parsers need, with their imports, several times over
WAITING = 12.0  # times as long may pass by the clock, where the machine is busy or the disk is far away
BYTES, BYTES_PER_BYTE = 2**31, 100
LOOKING = 0.05  # s between two looks at the memory of the process


class Worker:
    """Reads files in another process. To be used with `with`: the process ends there."""

    def __init__(self):
        self.process: subprocess.Popen | None = None

    def __enter__(self) -> "Worker":
        return self

    def __exit__(self, *_) -> None:
        self._end()

    def read(self, path: Path, frames: bool = False, prim: str | None = None) -> Contents:
        """The contents of a mesh file, as `files.parse` gives them. Raises SceneError where it fails or takes too much."""
        size = path.stat().st_size
        if self.process is not None and self.process.poll() is not None:
            self._end()
        if self.process is None and not self._start():
            return parse(path, frames, prim)  # a Python that cannot start another, such as one that is part of an application
        seconds, most = SECONDS + SECONDS_PER_MIB * size / 2**20, BYTES + BYTES_PER_BYTE * size
        answer, too_much = self._ask({"path": str(path.resolve()), "frames": frames, "prim": prim}, seconds, most)
        if answer is None:
            self._end()
            why = too_much or "the parser of this format ended its process"
            raise SceneError(f'mesh file "{path}": cannot be read as {path.suffix}: {why}; if it is whole, convert it to .npz')
        if isinstance(answer, str):
            raise SceneError(answer)
        return answer

    def _start(self) -> bool:
        executable = spawn.get_executable()
        if not executable or getattr(sys, "frozen", False):
            return False
        # what this process can import, the other can; -P: nothing from the folder that it happens to run in
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        command = [os.fsdecode(executable), "-P", "-c", "from pdipc.scene.worker import serve; serve()"]
        hidden = getattr(subprocess, "CREATE_NO_WINDOW", 0)  # Windows would open one
        try:
            self.process = subprocess.Popen(
                command,
                env=environment,
                creationflags=hidden,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
            )
        except OSError:
            return False
        if self._ask(None, START_SECONDS, BYTES)[0] is None:
            self._end()
            return False
        return True

    def _ask(self, request: dict | None, seconds: float, most: int) -> tuple[Contents | str | None, str]:
        """What the process answers, None where it is no more; and why it had to be ended, if it had."""
        running = self.process
        assert running is not None and running.stdin is not None and running.stdout is not None
        done, too_much = threading.Event(), []

        def watch() -> None:
            begun, worked = time.monotonic(), None
            while not done.wait(LOOKING):
                try:
                    process = psutil.Process(running.pid)
                    used, work = process.memory_info().rss, sum(process.cpu_times()[:2])
                except psutil.Error:
                    return
                worked = work if worked is None else worked
                if work - worked > seconds or time.monotonic() - begun > WAITING * seconds:
                    too_much.append(f"it took more than {seconds:.0f} s")
                elif used > most:
                    too_much.append(f"it took more than {most / 2**30:.3g} GiB of memory")
                if too_much:
                    running.kill()
                    return

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            if request is not None:
                running.stdin.write(json.dumps(request).encode() + b"\n")
                running.stdin.flush()
            return _receive(running.stdout), ""
        except (OSError, EOFError, ValueError):
            done.set()
            watcher.join()
            return None, too_much[0] if too_much else ""
        finally:
            done.set()
            watcher.join()

    def _end(self) -> None:
        process, self.process = self.process, None
        if process is not None:
            process.kill()
            process.wait()
            for pipe in filter(None, (process.stdin, process.stdout)):
                pipe.close()


def serve() -> None:
    """What the process does: reads requests from its input, a line each, and writes contents until the input ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what parsers print must not get among the answers
    _limit_memory()
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    _send(answers, "")
    for line in sys.stdin.buffer:
        request = json.loads(line)
        path = Path(request["path"])
        try:
            answer: Contents | str = parse(path, request["frames"], request["prim"])
        except SceneError as error:
            answer = str(error)
        except BaseException as error:
            answer = failed(path, error)
        try:
            _send(answers, answer)
        except (TypeError, ValueError, OverflowError, MemoryError) as error:  # what was read is no table of numbers
            _send(answers, failed(path, error))


def _end_with(parent: int) -> None:
    """Ends this process when the one that started it is gone, killed perhaps, whatever a parser is doing."""
    while os.getppid() == parent and psutil.pid_exists(parent):
        time.sleep(1.0)
    os._exit(1)


def _limit_memory() -> None:
    """The address space of this process, where the system can limit it: a single huge request fails at once."""
    try:
        import resource

        free = psutil.virtual_memory().available
        most = psutil.Process().memory_info().vms + free
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    except (ImportError, OSError, ValueError):
        pass


def failed(path: Path, error: BaseException) -> str:
    """What to say where a parser raised `error`."""
    said = " ".join("".join(c if c.isprintable() else " " for c in describe(error)).split())
    said = said if len(said) <= 300 else said[:297] + "..."
    return f'mesh file "{path}": cannot be read as {path.suffix}: {said}'


def describe(error: BaseException) -> str:
    """The message of an error, whatever it is made of: some quote bytes of the file that are no text."""
    if isinstance(error, MemoryError):
        return "it needs more memory than there is"
    try:
        text = str(error)
    except UnicodeDecodeError as bytes_in_it:
        text = bytes_in_it.object.decode("utf-8", errors="replace")
    except Exception:
        text = ""
    text = re.sub(r"Error in '[^']*' at line \d+ in file \S+ : ", "", text)  # USD says where in its own source
    text = re.sub(r"\S+\([^()]*\)\s+ERROR: EXCEPTION:\s+", "", text)  # and so does Alembic
    return text.strip() or type(error).__name__


def _send(file: IO[bytes], answer: Contents | str) -> None:
    arrays = {}
    if isinstance(answer, Contents):
        arrays = {"points": np.asarray(answer.points, dtype=np.float64)}
        arrays |= {
            name: np.asarray(array, dtype=np.int64) for name, array in zip(("corners", "counts"), answer.polygons, strict=True)
        }
        arrays |= {f"cells {k}": np.asarray(rows, dtype=np.int64) for k, (_, rows) in enumerate(answer.cells)}
        if answer.frames is not None:
            arrays |= {
                "frames": np.asarray(answer.frames, dtype=np.float64),
                "times": np.asarray(answer.times, dtype=np.float64),
            }
        told = {"kinds": [kind for kind, _ in answer.cells], "notes": answer.notes, "repeats": answer.repeats}
    else:
        told = {"failed": answer}
    packed = io.BytesIO()
    named: dict[str, Any] = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
    np.savez(packed, **named)
    data, text = packed.getvalue(), json.dumps(told).encode()
    file.write(len(text).to_bytes(8, "little") + len(data).to_bytes(8, "little") + text + data)
    file.flush()


def _receive(file: IO[bytes]) -> Contents | str:
    def take(count: int) -> bytes:
        data = file.read(count)
        if len(data) < count:
            raise EOFError
        return data

    lengths = take(16)
    told = json.loads(take(int.from_bytes(lengths[:8], "little")))
    data = take(int.from_bytes(lengths[8:], "little"))
    if "failed" in told:
        return told["failed"]
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        cells = [(kind, arrays[f"cells {k}"]) for k, kind in enumerate(told["kinds"])]
        polygons, moving = (arrays["corners"], arrays["counts"]), (arrays.get("frames"), arrays.get("times"))
        return Contents(arrays["points"], cells, polygons, told["notes"], told["repeats"], *moving)
