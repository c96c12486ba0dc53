"""Penetration-free projective dynamics for soft bodies and cloth (Lan et al., SIGGRAPH 2022) on NVIDIA Warp.

Names are imported when they are first used, so that reading a result or printing help does not load Warp.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pdipc.collision.queries import time_of_impact as time_of_impact
    from pdipc.drive import StepResult as StepResult
    from pdipc.drive import step as step
    from pdipc.judge.witness import find_intersections as find_intersections
    from pdipc.model import State as State
    from pdipc.model import build as build
    from pdipc.output.forces import ContactForces as ContactForces
    from pdipc.output.results import Run as Run
    from pdipc.output.results import RunError as RunError
    from pdipc.output.results import open_run as open_run
    from pdipc.scene.check import check as check_scene
    from pdipc.scene.errors import SceneError as SceneError
    from pdipc.scene.errors import SceneWarning as SceneWarning
    from pdipc.scene.garments import Inside as Inside
    from pdipc.scene.load import load_scene as load_scene
    from pdipc.scene.looks import Look as Look
    from pdipc.scene.looks import Picture as Picture
    from pdipc.scene.schema import Arrays as Arrays
    from pdipc.scene.schema import Attachment as Attachment
    from pdipc.scene.schema import Cloth as Cloth
    from pdipc.scene.schema import ClothMaterial as ClothMaterial
    from pdipc.scene.schema import Contact as Contact
    from pdipc.scene.schema import Copies as Copies
    from pdipc.scene.schema import Deformation as Deformation
    from pdipc.scene.schema import FrameArrays as FrameArrays
    from pdipc.scene.schema import Keyframe as Keyframe
    from pdipc.scene.schema import Motion as Motion
    from pdipc.scene.schema import Obstacle as Obstacle
    from pdipc.scene.schema import Pattern as Pattern
    from pdipc.scene.schema import Pin as Pin
    from pdipc.scene.schema import Rigid as Rigid
    from pdipc.scene.schema import RigidMaterial as RigidMaterial
    from pdipc.scene.schema import Rod as Rod
    from pdipc.scene.schema import RodMaterial as RodMaterial
    from pdipc.scene.schema import Scene as Scene
    from pdipc.scene.schema import Selection as Selection
    from pdipc.scene.schema import Simulation as SimulationSettings
    from pdipc.scene.schema import Solid as Solid
    from pdipc.scene.schema import SolidMaterial as SolidMaterial
    from pdipc.scene.schema import Stitch as Stitch
    from pdipc.scene.schema import VertexForce as VertexForce
    from pdipc.scene.schema import Wind as Wind
    from pdipc.simulation import Frame as Frame
    from pdipc.simulation import Simulation as Simulation
    from pdipc.simulation import run_scene as run_scene
    from pdipc.simulation import simulate as simulate
    from pdipc.sweeps.run import run_sweep as run_sweep
    from pdipc.sweeps.worlds import Worlds as Worlds
    from pdipc.sweeps.worlds import run_worlds as run_worlds

__version__ = "0.1.0"

# For type checkers and editors, which read no dictionary; a test holds the three lists together.
__all__ = [
    "Arrays",
    "Attachment",
    "Cloth",
    "ClothMaterial",
    "Contact",
    "ContactForces",
    "Copies",
    "Deformation",
    "Frame",
    "FrameArrays",
    "Inside",
    "Keyframe",
    "Look",
    "Motion",
    "Obstacle",
    "Pattern",
    "Picture",
    "Pin",
    "Rigid",
    "RigidMaterial",
    "Rod",
    "RodMaterial",
    "Run",
    "RunError",
    "Scene",
    "SceneError",
    "SceneWarning",
    "Selection",
    "Simulation",
    "SimulationSettings",
    "Solid",
    "SolidMaterial",
    "State",
    "StepResult",
    "Stitch",
    "VertexForce",
    "Wind",
    "Worlds",
    "build",
    "check_scene",
    "find_intersections",
    "load_scene",
    "open_run",
    "run_scene",
    "run_sweep",
    "run_worlds",
    "simulate",
    "step",
    "time_of_impact",
]

_PUBLIC = {
    "Arrays": "pdipc.scene.schema",
    "Attachment": "pdipc.scene.schema",
    "Cloth": "pdipc.scene.schema",
    "ClothMaterial": "pdipc.scene.schema",
    "Contact": "pdipc.scene.schema",
    "ContactForces": "pdipc.output.forces",
    "Copies": "pdipc.scene.schema",
    "Deformation": "pdipc.scene.schema",
    "Frame": "pdipc.simulation",
    "FrameArrays": "pdipc.scene.schema",
    "Inside": "pdipc.scene.garments",
    "Keyframe": "pdipc.scene.schema",
    "Look": "pdipc.scene.looks",
    "Motion": "pdipc.scene.schema",
    "Obstacle": "pdipc.scene.schema",
    "Pattern": "pdipc.scene.schema",
    "Picture": "pdipc.scene.looks",
    "Pin": "pdipc.scene.schema",
    "Rigid": "pdipc.scene.schema",
    "RigidMaterial": "pdipc.scene.schema",
    "Rod": "pdipc.scene.schema",
    "RodMaterial": "pdipc.scene.schema",
    "Run": "pdipc.output.results",
    "RunError": "pdipc.output.results",
    "Scene": "pdipc.scene.schema",
    "SceneError": "pdipc.scene.errors",
    "SceneWarning": "pdipc.scene.errors",
    "Selection": "pdipc.scene.schema",
    "Simulation": "pdipc.simulation",
    "SimulationSettings": "pdipc.scene.schema:Simulation",
    "Solid": "pdipc.scene.schema",
    "SolidMaterial": "pdipc.scene.schema",
    "State": "pdipc.model",
    "StepResult": "pdipc.drive",
    "Stitch": "pdipc.scene.schema",
    "VertexForce": "pdipc.scene.schema",
    "Wind": "pdipc.scene.schema",
    "Worlds": "pdipc.sweeps.worlds",
    "build": "pdipc.model",
    "check_scene": "pdipc.scene.check:check",
    "find_intersections": "pdipc.judge.witness",
    "load_scene": "pdipc.scene.load",
    "open_run": "pdipc.output.results",
    "run_scene": "pdipc.simulation",
    "run_sweep": "pdipc.sweeps.run",
    "run_worlds": "pdipc.sweeps.worlds",
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
