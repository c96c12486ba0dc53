"""The combinations of a sweep, and what a worker does with one."""

import itertools
import json
import time
import warnings
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pdipc.output.results import RunError, RunLockedError, open_run, resumable_step
from pdipc.scene.errors import SceneError, SceneWarning
from pdipc.scene.load import load_scene
from pdipc.scene.worlds import refuse_worlds

MOST_RUNS = 100_000
LOCKED_SECONDS = 0.5  # between two looks at a run that another process writes


@dataclass(frozen=True)
class Case:
    """One combination: its number, its values by key, and its scene as JSON, with files named in full."""

    number: int
    values: dict[str, Any]
    scene: str

    @property
    def folder(self) -> str:
        """The name of its run folder."""
        return f"{self.number:04d}"

    @cached_property
    def steps(self) -> int:
        """Those of its whole run."""
        return json.loads(self.scene)["simulation"]["steps"]

    def __str__(self) -> str:
        return ", ".join(f"{key} = {text_of(value)}" for key, value in self.values.items())


def text_of(value: Any) -> str:
    """A value in a cell; the digits of a number give it back."""
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)


def combinations(scene: str | Path, settings: dict[str, list[Any]]) -> list[Case]:
    """Every combination of the values in `settings`, by dotted keys, for the scene of a file or bundled name.

    Raises SceneError where a key leads nowhere or a combination is no scene, before anything runs.
    """
    count = 1
    for values in settings.values():
        count *= len(values)
    if not settings or not count:
        raise SceneError("a sweep needs a key and values for it, such as contact.friction=0.1,0.3")
    if count > MOST_RUNS:
        raise SceneError(f"these values have {count} combinations; a sweep takes at most {MOST_RUNS}")
    cases = []
    for number, values in enumerate(itertools.product(*settings.values())):
        changes = dict(zip(settings, values, strict=True))
        made = load_scene(scene, changes)
        refuse_worlds(made, "each run of a sweep")
        cases.append(Case(number, changes, made.model_dump_json()))
    return cases


def check_case(case: Case, version: str) -> list[str]:
    """What is left out of the scene's files, a line each. Raises SceneError where it cannot be simulated, RunError for another version."""
    from pdipc import __version__
    from pdipc.scene.assembly import assemble
    from pdipc.scene.check import refuse
    from pdipc.scene.schema import Scene

    if version != __version__:
        raise RunError(f"a worker has pdipc {__version__}, and this is {version}")
    scene = Scene.model_validate_json(case.scene)
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", SceneWarning)
        refuse(scene, assemble(scene), "float32" if scene.simulation.precision == "float32" else "float64")
    return [str(each.message) for each in told if issubclass(each.category, SceneWarning)]


def run_case(case: Case, folder: str) -> int | str:
    """Simulates, or goes on, in the case's folder below `folder`; returns the step that it went on from, or what went wrong."""
    from pdipc.scene.schema import Scene
    from pdipc.simulation import run_scene

    own = Path(folder) / case.folder
    while True:
        try:
            begun = (own / "run.json").is_file()
            first = resumable_step(open_run(own)) if begun else 0
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", SceneWarning)  # `check_case` has told
                run_scene(Scene.model_validate_json(case.scene), own, resume=begun)
            return first
        except RunLockedError:
            time.sleep(LOCKED_SECONDS)  # by a worker that was given up too early: it dies, or finishes
        except Exception as error:
            return str(error) or type(error).__name__  # the other runs go on
