"""Penetration-free projective dynamics for soft bodies and cloth (Lan et al., SIGGRAPH 2022) on NVIDIA Warp.

Names are imported when they are first used, so that reading a result or printing help does not load Warp.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pdipc.collision.queries import time_of_impact as time_of_impact
    from pdipc.drive import step as step
    from pdipc.judge.witness import find_intersections as find_intersections
    from pdipc.model import build as build
    from pdipc.output.results import RunError as RunError
    from pdipc.output.results import open_run as open_run
    from pdipc.scene.check import check as check_scene  # noqa: F401
    from pdipc.scene.errors import SceneError as SceneError
    from pdipc.scene.load import load_scene as load_scene
    from pdipc.scene.schema import Scene as Scene
    from pdipc.simulation import Simulation as Simulation
    from pdipc.simulation import run_scene as run_scene
    from pdipc.simulation import simulate as simulate
    from pdipc.sweeps import run_sweep as run_sweep

__version__ = "0.1.0"

_PUBLIC = {
    "RunError": "pdipc.output.results",
    "Scene": "pdipc.scene.schema",
    "SceneError": "pdipc.scene.errors",
    "Simulation": "pdipc.simulation",
    "build": "pdipc.model",
    "check_scene": "pdipc.scene.check:check",
    "find_intersections": "pdipc.judge.witness",
    "load_scene": "pdipc.scene.load",
    "open_run": "pdipc.output.results",
    "run_scene": "pdipc.simulation",
    "run_sweep": "pdipc.sweeps",
    "simulate": "pdipc.simulation",
    "step": "pdipc.drive",
    "time_of_impact": "pdipc.collision.queries",
}

_MODULES = ("newton",)  # parts that need an extra


def __getattr__(name: str) -> object:
    if name in _MODULES:
        return importlib.import_module(f"pdipc.{name}")
    if name not in _PUBLIC:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, attribute = _PUBLIC[name].partition(":")
    return getattr(importlib.import_module(module), attribute or name)


def __dir__() -> list[str]:
    return sorted([*_PUBLIC, *_MODULES, "__version__"])
