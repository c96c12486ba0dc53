"""What a scene file may say: the pydantic models behind the TOML keys and the Python arguments of the same names.

Units are SI (m, kg, s, N, Pa); orientations are in degrees, rates of rotation in rad/s; y points up. Unknown keys are refused.
"""

import importlib
import itertools
import os
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    Discriminator,
    Field,
    PlainSerializer,
    StrictBool,
    Tag,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)

from pdipc.scene import generators
from pdipc.scene.explain import short
from pdipc.scene.garments import Inside
from pdipc.scene.looks import Look, Picture
from pdipc.scene.tables import Index, NotNegative, Number, Positive, Real, Table, Vector, Whole
from pdipc.scene.vary import flat, split_key

SHORTEST_STEP = 1e-9  # s
MOST_WORLDS = 10_000

Count = Annotated[Whole, Field(ge=1, le=10**9)]


def _no_instant(seconds: float) -> float:
    if seconds < SHORTEST_STEP:
        raise ValueError(f"must be at least {SHORTEST_STEP:g} s: 1 / h^2 has to be a number")
    return seconds


def _some_axes(axes: str) -> str:
    if not axes or set(axes) - set("xyz") or len(set(axes)) < len(axes):
        raise ValueError(f'must be one to three of the letters x, y and z, each once, such as "xz"; is "{axes}"')
    return "".join(sorted(axes))


def _exactly_one(table: BaseModel, *names: str) -> None:
    given = [name for name in names if getattr(table, name) not in (None, False)]
    if len(given) != 1:
        raise ValueError(f"exactly one of {', '.join(names)} is needed; given: {', '.join(given) or 'none'}")


# --- simulation and contact ---


class Simulation(Table):
    """How time advances."""

    time_step: Annotated[Positive, AfterValidator(_no_instant)] = Field(
        default=0.01, le=1.0, description="Length h of a step, s."
    )
    steps: Whole = Field(default=200, ge=0, description="Number of steps of a run.")
    substeps: Whole = Field(default=1, ge=1, le=1000, description="Solves in a step, each of h / substeps.")
    gravity: Vector = Field(default=(0.0, -9.81, 0.0), description="Acceleration of every body, m/s^2.")
    damping: NotNegative = Field(
        default=0.0,
        le=1e4,
        description="Mass-proportional damping, 1/s: the part of its velocity that a free body loses per second.",
    )
    precision: Literal["auto", "float32", "float64"] = Field(
        default="auto",
        description='Working precision; "auto": float64 on CPUs; on CUDA float32, unless a solid is too stiff for it.',
    )
    device: str | None = Field(default=None, description='"cpu" or "cuda:0"; absent: CUDA where there is one, else the CPU.')
    tolerance: Positive | None = Field(
        default=None,
        le=100.0,
        description="A step has converged when its error is below this speed times the time step, m/s. Absent: 0.01 m/s, as strict as what "
        "other IPC simulators ship, or a thousandth of the smallest body's size a step where that is less.",
    )
    outer_tolerance: Positive | None = Field(
        default=None,
        le=1.0,
        description="The tolerance in another unit: a part of the largest body's size. Not beside `tolerance`.",
    )
    nonlinear_solver: Literal["auto", "newton", "local-global"] = Field(
        default="auto",
        description='How the nonlinear problem of a step is solved; "auto" is newton, unless a setting of local-global '
        "(inner_iterations, linear_solver, linear_iterations, linear_tolerance, solver_order, solver_drop) is given.",
    )
    max_outer: Whole | None = Field(
        default=None,
        ge=1,
        le=10**6,
        description="Most outer iterations of a step; a step that ends here is feasible, and says so. Absent: 1000 by Newton's method, "
        "whose hardest impacts take hundreds, else 100.",
    )
    inner_iterations: Whole = Field(
        default=30, ge=1, le=10**6, description="Most local-global iterations in an outer iteration."
    )
    linear_solver: Literal[
        "auto", "pcg", "two-level", "jacobi", "chebyshev", "a-jacobi", "matrix-powers", "gauss-seidel", "sor", "direct"
    ] = Field(
        default="auto",
        description='Solver of the global step; "auto": two-level (on CUDA pcg), with the paper\'s contact a-jacobi.',
    )
    linear_iterations: Whole = Field(default=20, ge=1, le=10**5, description="Most iterations of a global solve.")
    linear_tolerance: Positive = Field(
        default=1e-2, lt=1.0, description="A global solve ends when its residual has fallen to this part of the first."
    )
    solver_order: Whole = Field(default=2, ge=1, le=3, description="Sweeps that a-jacobi and matrix-powers take in one.")
    solver_drop: NotNegative = Field(
        default=0.0,
        lt=1.0,
        description="a-jacobi leaves out A-products that are below this part of the largest in their row (the paper: two or three "
        "orders smaller); how much that is, is in the run's `solver_dropped`.",
    )
    budget_ms: Positive | None = Field(
        default=None,
        description="Time after which a step takes no further outer iteration, ms; results then depend on the machine.",
    )


LOCAL_GLOBAL_ONLY = frozenset(
    {"inner_iterations", "linear_solver", "linear_iterations", "linear_tolerance", "solver_order", "solver_drop"}
)  # settings that choose local-global where nonlinear_solver is "auto"


def uses_newton(simulation: Simulation) -> bool:
    """Whether the barrier's contact is solved by Newton's method."""
    if simulation.nonlinear_solver != "auto":
        return simulation.nonlinear_solver == "newton"
    return not local_global_settings(simulation)


def local_global_settings(simulation: Simulation) -> list[str]:
    """The settings of local-global that differ from their defaults: whether one was given does not survive a file of all settings."""
    fields = type(simulation).model_fields
    return sorted(name for name in LOCAL_GLOBAL_ONLY if getattr(simulation, name) != fields[name].default)


class Contact(Table):
    """How surfaces keep apart. Distances that are absent follow from the sizes of bodies: see `pdipc.scene.assembly.Assembly`."""

    method: Literal["barrier", "paper"] = Field(
        default="barrier",
        description='"barrier": forces of the barrier, which converge to those of IPC. "paper": position targets as printed, Eq. (6), '
        "to reproduce the paper; as safe, but less accurate, and without friction.",
    )
    activation_distance: Positive | None = Field(
        default=None,
        description="Gap at which the barrier sets in (d_hat), m; absent: 1e-3 of the largest body's size; at least 1e-7 of it.",
    )
    minimum_separation: Positive | None = Field(
        default=None,
        description="Gap that no pair of surfaces ever closes (xi), m; absent: 0.02 activation_distance. Bodies may differ.",
    )
    stiffness_scale: Positive = Field(
        default=100.0, description="Barrier stiffness, in units of a typical vertex mass / h^2; results hardly depend on it."
    )
    friction: NotNegative = Field(default=0.0, le=10.0, description="Coulomb friction coefficient; a body may set its own.")
    friction_velocity: Positive = Field(default=1e-3, description="Sliding slower than this counts as sticking, m/s.")
    broad_phase: Literal["auto", "patches", "bvh"] = Field(
        default="auto",
        description="Culling: patches of the rest shape (Section 7.2), trees over primitives, or what measured faster (patches).",
    )
    truncation: Literal["auto", "per_vertex", "global"] = Field(
        default="auto",
        description='"global" cuts the whole step at the first impact, as the paper does; "per_vertex" only where it happens; '
        '"auto": as the method does.',
    )
    restitution: Annotated[Real, Field(ge=0.0, le=1.0)] | None = Field(
        default=None,
        description="Part of the speed of approach that surfaces part with after an impact (eps of Eq. 6). Absent: what the barrier "
        "gives back, 0 to 0.1 for most impacts and steps; with the paper's method 0.",
    )
    start: Literal["as_given", "separate"] = Field(
        default="as_given",
        description='Surfaces that intersect, or are too near, at the start: "as_given" refuses them; "separate" moves bodies apart first, as little '
        "as it finds, and says how far (docs/starts.md).",
    )
    start_limit: Positive | None = Field(
        default=None,
        description='How far "separate" may move a vertex, m; absent: a tenth of the largest body\'s size.',
    )

    quarantine: list[tuple[str, str]] = Field(
        default=[],
        description="Pairs of bodies, by name, that may intersect at the start: such a pair ignores each other until it has parted, and every result "
        "says so. Copies are `name[0]`, ...",
    )

    @model_validator(mode="after")
    def _check_start(self) -> "Contact":
        if self.start_limit is not None and self.start != "separate":
            raise ValueError('start_limit has no effect unless start = "separate"')
        return self


# --- meshes and where they stand ---


def _rows(dtype: type, width: int) -> BeforeValidator:
    kinds, needed = ("iu", "whole numbers") if dtype is np.int64 else ("iuf", "numbers")

    def read(value: Any) -> np.ndarray:
        if not isinstance(value, np.ndarray):
            _refuse_other_than_numbers(value, width, needed)
        try:
            array = np.asarray(value, dtype=None if isinstance(value, np.ndarray) or dtype is np.int64 else dtype)
        except (OverflowError, ValueError) as error:
            raise ValueError(f"must be {needed} that 64 bits hold: {error}") from None
        if array.size and array.dtype.kind not in kinds:
            raise ValueError(f"must be {needed}; is an array of {array.dtype}")
        if array.size and (array.ndim != 2 or array.shape[1] != width):
            raise ValueError(f"has the shape {array.shape}; must be (n, {width})")
        if dtype is np.int64 and array.size and array.max() > np.iinfo(np.int64).max:
            raise ValueError("must be whole numbers that 64 bits hold")
        return array.reshape(-1, width).astype(dtype)

    return BeforeValidator(read)


def _refuse_other_than_numbers(value: Any, width: int, needed: str) -> None:
    """Raises ValueError, with the place, where a list holds what is no number: NumPy would take text and truth values for some."""
    if not isinstance(value, list | tuple):
        raise ValueError(f"must be a list of lists of {width} {needed}")
    for row, cells in enumerate(value):
        if not isinstance(cells, list | tuple) and not (isinstance(cells, np.ndarray) and cells.ndim == 1):
            raise ValueError(f"must be a list of lists of {width} {needed}; [{row}] is {short(cells)}")
        for column, cell in enumerate(cells):
            if type(cell) is not float and type(cell) is not int and not isinstance(cell, np.integer | np.floating):
                raise ValueError(f"must be {needed}; [{row}][{column}] is {short(cell)}")


def _rows_schema(kind: str, width: int) -> WithJsonSchema:
    row = {"type": "array", "items": {"type": kind}, "minItems": width, "maxItems": width}
    return WithJsonSchema({"type": "array", "items": row})


_AS_LIST = PlainSerializer(lambda array: array.tolist(), return_type=list)
Points = Annotated[np.ndarray, _rows(np.float64, 3), _AS_LIST, _rows_schema("number", 3)]
Triangles = Annotated[np.ndarray, _rows(np.int64, 3), _AS_LIST, _rows_schema("integer", 3)]
Lines = Annotated[np.ndarray, _rows(np.int64, 2), _AS_LIST, _rows_schema("integer", 2)]
Tets = Annotated[np.ndarray, _rows(np.int64, 4), _AS_LIST, _rows_schema("integer", 4)]


_FRAMES_SCHEMA = WithJsonSchema({"type": "array", "items": _rows_schema("number", 3).json_schema})


def _frames(value: Any) -> np.ndarray:
    """(f, n, 3) numbers, in Python an array, in files lists."""
    if not isinstance(value, np.ndarray):
        if not isinstance(value, list | tuple):
            raise ValueError("must be a list of frames, each a list of lists of 3 numbers")
        for frame in value:
            if not isinstance(frame, np.ndarray):
                _refuse_other_than_numbers(frame, 3, "numbers")
        try:
            value = np.asarray(value, dtype=np.float64)
        except (OverflowError, ValueError, TypeError) as error:
            raise ValueError(f"must be numbers that 64 bits hold, and each frame of as many vertices: {error}") from None
    if value.dtype.kind not in "iuf" or value.ndim != 3 or value.shape[2] != 3:
        raise ValueError(f"has the shape {value.shape} and is {value.dtype}; must be numbers (f, n, 3)")
    return value


class Arrays(Table):
    """A mesh given by its numbers: tets for a solid, triangles for cloth and obstacles, lines for a rod."""

    vertices: Points = Field(description="V (n, 3): rest positions, m.")
    tets: Tets | None = Field(default=None, description="T (t, 4): indices into vertices.")
    triangles: Triangles | None = Field(
        default=None, description="F (m, 3): indices into vertices; a solid's follow from its tets."
    )
    lines: Lines | None = Field(default=None, description="L (s, 2): indices into vertices, the segments of a rod.")
    start: Points | None = Field(default=None, description="(n, 3): positions at the start where these differ from rest, m.")

    @model_validator(mode="after")
    def _check(self) -> "Arrays":
        if self.tets is None and self.triangles is None and self.lines is None:
            raise ValueError("tets, triangles or lines are needed")
        if self.start is not None and self.start.shape != self.vertices.shape:
            raise ValueError(f"start has the shape {self.start.shape}; it must be that of vertices, {self.vertices.shape}")
        return self

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Arrays) and all(np.array_equal(a, getattr(other, name)) for name, a in self if a is not None)


def _resolve(path: str, info: ValidationInfo) -> str:
    """A path in a scene file is relative to the file."""
    folder = (info.context or {}).get("folder")
    if folder is None or path.startswith("warp:"):
        return path
    try:
        whole = Path(folder) / path
        return os.path.abspath(whole) if "*" in path else str(whole.resolve())  # no file has the name of a pattern
    except (OSError, RuntimeError, ValueError) as error:  # links in circles, names that are too long
        raise ValueError(f"is no path to a file: {error}") from None


def _mesh_kind(value: Any) -> str | None:
    if isinstance(value, (str, Path)):
        return "file"
    if isinstance(value, Arrays) or (isinstance(value, dict) and "vertices" in value):
        return "arrays"
    shape = value.get("shape") if isinstance(value, dict) else getattr(value, "shape", None)
    return shape if isinstance(shape, str) else None


SHAPE_NAMES = tuple(shape.model_fields["shape"].default for shape in generators.SHAPES)
_File = Annotated[str, BeforeValidator(str), AfterValidator(_resolve)]
MeshSource = Annotated[
    Annotated[_File, Tag("file")]
    | Annotated[Arrays, Tag("arrays")]
    | Annotated[generators.Box, Tag("box")]
    | Annotated[generators.Sphere, Tag("sphere")]
    | Annotated[generators.Cylinder, Tag("cylinder")]
    | Annotated[generators.Capsule, Tag("capsule")]
    | Annotated[generators.Torus, Tag("torus")]
    | Annotated[generators.Bowl, Tag("bowl")]
    | Annotated[generators.Stairs, Tag("stairs")]
    | Annotated[generators.Grid, Tag("grid")]
    | Annotated[generators.Plane, Tag("plane")]
    | Annotated[generators.Rope, Tag("rope")]
    | Annotated[generators.Ring, Tag("ring")]
    | Annotated[generators.Coil, Tag("coil")]
    | Annotated[generators.Knot, Tag("knot")]
    | Annotated[generators.Skirt, Tag("skirt")]
    | Annotated[generators.Figure, Tag("figure")],
    Discriminator(
        _mesh_kind,
        custom_error_type="mesh",
        custom_error_message="must be a file path, a table with shape = "
        + ", ".join(f'"{name}"' for name in SHAPE_NAMES)
        + ", or a table with vertices and tets, triangles or lines",
    ),
]


class Placed(Table):
    """A mesh, and where it stands: x = translation + R (scale * vertex)."""

    name: str = Field(min_length=1, max_length=200, description="Name, unique in the scene.")
    mesh: MeshSource = Field(
        description="A mesh file (relative to the scene file, or `warp:FILE` for an asset of Warp; of USD and Alembic also "
        "a part, `shot.usda</World/Flag>`), a shape, or arrays."
    )
    scale: Positive | tuple[Positive, Positive, Positive] = Field(
        default=1.0, description="Factor on the mesh's coordinates; along x, y, z if three."
    )
    rotation: Vector = Field(
        default=(0.0, 0.0, 0.0), description="Turns about the fixed axes x, then y, then z, degrees; about the mesh's origin."
    )
    translation: Vector = Field(default=(0.0, 0.0, 0.0), description="Where the mesh's origin goes, m.")
    friction: NotNegative | None = Field(
        default=None, le=10.0, description="Friction coefficient; absent: that of `contact`. A pair takes the geometric mean."
    )
    minimum_separation: Positive | None = Field(
        default=None,
        description="Gap kept between copies of this body, such as the thickness of cloth, m; two bodies keep the mean. "
        "Absent: that of `contact`.",
    )
    look: Look = Field(default_factory=Look, description="How it is drawn.")


# --- materials ---


class SolidMaterial(Table):
    """Isotropic and elastic."""

    density: Positive = Field(default=1000.0, le=1e5, description="Mass per volume, kg/m^3.")
    young_modulus: Positive = Field(default=1e5, le=1e12, description="Young's modulus, Pa.")
    poisson_ratio: Real = Field(default=0.4, ge=0, le=0.499, description="Poisson's ratio.")
    model: Literal["auto", "arap", "corotated", "neo_hookean"] = Field(
        default="auto",
        description="The elastic energy; all are Hooke's law for small strains. arap: the paper's constraints of strain and volume; "
        "corotated and neo_hookean stay smooth where elements are flattened or inverted, and need the Newton solver. auto: "
        "neo_hookean with the Newton solver, else arap.",
    )


class ClothMaterial(Table):
    """A thin sheet: stretched by its membrane stiffness, bent by its bending stiffness."""

    areal_density: Positive = Field(default=0.2, le=1e4, description="Mass per area, kg/m^2.")
    thickness: Positive = Field(
        default=1e-3, le=1.0, description="Thickness, m: turns young_modulus into the two stiffnesses; contact ignores it."
    )
    young_modulus: Positive | None = Field(default=None, le=1e12, description="Young's modulus, Pa; absent: 1e5.")
    membrane_stiffness: Positive | None = Field(
        default=None, le=1e9, description="Young's modulus times thickness, N/m; in place of young_modulus."
    )
    poisson_ratio: Real = Field(default=0.3, ge=0, le=0.499, description="Poisson's ratio in the plane.")
    weft_stiffness: Positive | None = Field(
        default=None,
        le=1e9,
        description="Of woven cloth along its weft, N/m; membrane_stiffness is then that along its warp. Absent: alike in all directions. "
        "Needs the Newton solver, as all of woven cloth does.",
    )
    shear_stiffness: Positive | None = Field(
        default=None,
        le=1e9,
        description="Of woven cloth, N/m: force per length over angle. Absent: sqrt(warp weft) / (2 (1 + poisson_ratio)), as without a weave.",
    )
    warp: Vector | None = Field(
        default=None,
        description="Direction of the warp of woven cloth, in the coordinates of the flat rest shape, else of the mesh; absent: (1, 0, 0).",
    )
    strain_limit: Positive | None = Field(
        default=None,
        le=10.0,
        description="By what part of its rest length cloth stretches at most, in any direction; holds within 1 % of itself. Needs the Newton "
        "solver.",
    )
    area_stiffness: NotNegative = Field(
        default=0.0,
        le=1e9,
        description="Of a resistance to changes of area, on top of what poisson_ratio gives, N/m: force per length over relative "
        "change of area.",
    )
    bending_stiffness: NotNegative | None = Field(
        default=None,
        le=1e6,
        description="Flexural rigidity, N m; absent: membrane_stiffness thickness^2 / 12 / (1 - poisson_ratio^2).",
    )
    weft_bending_stiffness: Positive | None = Field(
        default=None,
        le=1e6,
        description="Flexural rigidity of a strip cut along the weft, N m; bending_stiffness is then that of one cut along the warp. "
        "Absent: alike in all directions.",
    )
    bending: Literal["quadratic", "curved"] = Field(
        default="quadratic", description='"quadratic" for cloth that is flat at rest, "curved" keeps a curved rest shape.'
    )
    membrane: Literal["strain", "springs"] = Field(
        default="strain", description='"springs" replaces the triangles\' elasticity by one spring an edge.'
    )

    @property
    def is_woven(self) -> bool:
        """Whether its membrane is stiffer one way than another."""
        return self.weft_stiffness is not None or self.shear_stiffness is not None

    @property
    def has_warp(self) -> bool:
        """Whether anything of it depends on where its warp lies."""
        return self.is_woven or self.weft_bending_stiffness is not None

    @model_validator(mode="after")
    def _fill(self) -> "ClothMaterial":
        """Completes the stiffnesses, so that readers find numbers; what was given stays known in `model_fields_set`."""
        stretch, bend = self.membrane_stiffness, self.bending_stiffness
        if self.membrane == "springs":
            for name in ("area_stiffness", "weft_stiffness", "shear_stiffness", "warp"):
                if getattr(self, name):
                    raise ValueError(f'{name} has no effect on springs; take membrane = "strain"')
        if self.warp is not None and not (self.has_warp and any(self.warp)):
            raise ValueError(
                "warp must be a direction, and needs weft_stiffness, shear_stiffness or weft_bending_stiffness beside it"
            )
        if self.weft_bending_stiffness is not None:
            if self.bending == "curved":
                raise ValueError('weft_bending_stiffness has no effect on bending = "curved"; take "quadratic"')
            if bend == 0.0:
                raise ValueError("weft_bending_stiffness needs a bending_stiffness above 0 beside it, that along the warp")
        if stretch is None or "membrane_stiffness" not in self.model_fields_set:
            stretch = (self.young_modulus or 1e5) * self.thickness
        elif self.young_modulus and not np.isclose(self.young_modulus * self.thickness, stretch, rtol=1e-6):
            raise ValueError(
                f"membrane_stiffness = {stretch} N/m contradicts young_modulus * thickness = "
                f"{self.young_modulus * self.thickness} N/m; give one of the two"
            )
        if bend is None or "bending_stiffness" not in self.model_fields_set:
            bend = stretch * self.thickness**2 / (12 * (1 - self.poisson_ratio**2))
        object.__setattr__(self, "membrane_stiffness", stretch)
        object.__setattr__(self, "bending_stiffness", bend)
        return self


class RodMaterial(Table):
    """A round, thin body that stretches, bends and twists: Young's modulus and radius give the three stiffnesses that are left open."""

    density: Positive = Field(default=1000.0, le=1e5, description="Mass per volume, kg/m^3.")
    radius: Positive = Field(default=5e-3, le=1e3, description="Radius of the cross section, m: also its thickness in contact.")
    young_modulus: Positive = Field(default=1e6, le=1e12, description="Young's modulus E, Pa.")
    poisson_ratio: Real = Field(default=0.3, ge=0, le=0.5, description="Poisson's ratio nu.")
    stretch_stiffness: Positive | None = Field(
        default=None, le=1e12, description="E A, N: force per strain; absent: E pi radius^2."
    )
    bending_stiffness: NotNegative | None = Field(
        default=None, le=1e12, description="E I, N m^2: moment per curvature; absent: E pi radius^4 / 4."
    )
    twist_stiffness: NotNegative | None = Field(
        default=None,
        le=1e12,
        description="G J, N m^2: torque per twist; absent: E pi radius^4 / 4 / (1 + nu), or 0 where bending_stiffness is 0. 0: it "
        "twists freely, as chains do, which is faster; any other value needs the Newton solver.",
    )

    @model_validator(mode="after")
    def _fill(self) -> "RodMaterial":
        """Completes the stiffnesses, so that readers find numbers; what was given stays known in `model_fields_set`."""
        area = np.pi * self.radius**2
        stretch, bend, twist = (
            getattr(self, name) if name in self.model_fields_set else None
            for name in ("stretch_stiffness", "bending_stiffness", "twist_stiffness")
        )
        bent = self.young_modulus * area * self.radius**2 / 4.0 if bend is None else bend
        if twist and not bent:
            raise ValueError(
                f"twist_stiffness = {twist} N m^2 without bending_stiffness: what is to twist must resist bending, too"
            )
        object.__setattr__(self, "stretch_stiffness", self.young_modulus * area if stretch is None else stretch)
        object.__setattr__(self, "bending_stiffness", bent)
        if twist is None:
            twist = self.young_modulus * area * self.radius**2 / 4.0 / (1.0 + self.poisson_ratio) if bent else 0.0
        object.__setattr__(self, "twist_stiffness", twist)
        return self


# --- motions, pins, attachments ---


class Keyframe(Table):
    """Where something is at one time, relative to its start."""

    time: NotNegative = Field(description="Time, s.")
    translation: Vector = Field(default=(0.0, 0.0, 0.0), description="Displacement from the start, m.")
    rotation: Vector = Field(
        default=(0.0, 0.0, 0.0), description="Turn from the start, about the axes x, then y, then z through `center`, degrees."
    )


class Motion(Table):
    """A scripted rigid motion: keyframes, or a constant velocity and spin in a time window."""

    keyframes: list[Keyframe] = Field(
        default=[],
        description="Poses in order of time; held before the first and after the last.",
    )
    turns: Literal["as_given", "shortest"] = Field(
        default="as_given",
        description='Between two keyframes, "as_given" interpolates each angle, so that 720 degrees are two turns; "shortest" turns '
        "evenly about one axis, by no more than 180 degrees.",
    )
    smooth: StrictBool = Field(default=False, description="Ease in and out between keyframes, without jumps of velocity.")
    velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="Velocity of `center`, m/s.")
    angular_velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="Spin, rad/s: its direction is the axis.")
    center: Vector | None = Field(
        default=None, description="Point at the start that rotations turn about, m; absent: the middle of the bounding box."
    )
    start: NotNegative = Field(default=0.0, description="When velocity and spin begin, s.")
    end: Positive | None = Field(default=None, description="When they end, s; absent: never.")

    @model_validator(mode="after")
    def _check(self) -> "Motion":
        if self.keyframes and (any(self.velocity) or any(self.angular_velocity)):
            raise ValueError("keyframes exclude velocity and angular_velocity")
        times = [keyframe.time for keyframe in self.keyframes]
        if any(b <= a for a, b in itertools.pairwise(times)):
            raise ValueError(f"keyframes must be in order of time; their times are {times}")
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end = {self.end} s must be later than start = {self.start} s")
        return self


class Selection(Table):
    """Vertices of a body, chosen in one way; places are those at the start, in the scene's coordinates."""

    vertices: list[Index] | None = Field(default=None, description="Indices into the body's vertices.")
    box: tuple[Vector, Vector] | None = Field(default=None, description="Lower and upper corner, m.")
    sphere: tuple[Vector, Positive] | None = Field(default=None, description="Centre and radius, m.")
    nearest: Vector | None = Field(default=None, description="The one vertex nearest to this point, m.")
    seam: StrictBool = Field(default=False, description="Those that stitches or attachments join to anything.")
    all: StrictBool = Field(default=False, description="Every vertex.")

    @model_validator(mode="after")
    def _check(self) -> "Selection":
        _exactly_one(self, "vertices", "box", "sphere", "nearest", "seam", "all")
        if self.box is not None and any(low > high for low, high in zip(*self.box, strict=True)):
            raise ValueError(f"box: the lower corner {self.box[0]} is above the upper corner {self.box[1]}")
        return self

    def __str__(self) -> str:
        """As it is written in a scene, such as "{ sphere = ((0.0, 0.0, 0.0), 1.0) }"."""
        return "".join(f"{{ {name} = {value} }}" for name, value in self if value not in (None, False))


class Pin(Table):
    """Vertices held where they are, or led along a motion or with a surface, as far as nothing is in the way.

    A pin that begins later catches its vertices where they are then, and goes on from there; at its end it lets go.
    """

    select: Selection = Field(description="Which vertices.")
    motion: Motion | None = Field(default=None, description="How the points that hold them move; absent: not at all.")
    stiffness: Positive | None = Field(
        default=None, description="Of the spring from each vertex to its point, N/m; absent: held exactly."
    )
    axes: Annotated[str, AfterValidator(_some_axes)] = Field(
        default="xyz",
        description='Along which axes it holds; along the others its vertices are free. "y" holds a height, "xz" is a rail along y. Fewer '
        "than three need a stiffness.",
    )
    follow: str | None = Field(
        default=None,
        description="Name of what it moves with, in place of a motion. Held exactly, vertices move as if glued to an obstacle; with a "
        "stiffness, each hangs on the nearest point of the surface of an obstacle or another body, which feels it too.",
    )
    start: NotNegative = Field(default=0.0, description="When it begins to hold, s.")
    end: Positive | None = Field(default=None, description="When it lets go, s; absent: never.")

    @model_validator(mode="after")
    def _check(self) -> "Pin":
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end = {self.end} s must be later than start = {self.start} s")
        if self.axes != "xyz" and self.stiffness is None:
            raise ValueError(f'axes = "{self.axes}" needs a stiffness: what is held exactly is held along all axes')
        if self.follow is not None and self.motion is not None:
            raise ValueError("follow excludes motion: it moves with what it follows")
        if self.follow is not None and self.axes != "xyz":
            raise ValueError("follow excludes axes: it holds along all of them")
        if self.follow is not None and self.stiffness is not None and (self.start > 0.0 or self.end is not None):
            raise ValueError("follow with a stiffness takes no start and no end; held exactly it does")
        return self


class Attachment(Table):
    """Springs between vertices of two bodies."""

    bodies: tuple[str, str] = Field(description="Names of the two bodies; an obstacle may be one; both may be the same.")
    pairs: list[tuple[Index, Index]] | None = Field(
        default=None, description="Vertex of the first and of the second body, pair by pair."
    )
    within: Positive | None = Field(
        default=None,
        description="Attach each vertex of the first body to the nearest one of the second that is no further than this, m.",
    )
    stiffness: Positive = Field(default=1000.0, description="Of each spring, N/m.")
    rest_length: NotNegative | None = Field(
        default=None, description="Length at which springs are at rest, m; absent: the one at the start."
    )

    @model_validator(mode="after")
    def _check(self) -> "Attachment":
        _exactly_one(self, "pairs", "within")
        return self


class Stitch(Table):
    """Threads that sew a cloth: from vertices of one body to points of another, or of another part of the same.

    A thread only pulls, with stiffness (distance - length) once the distance is more than its length, which shrinks evenly from the
    distance at the start to `length`. Contact keeps its gap all the same: sewn edges meet as near as surfaces may.
    """

    bodies: tuple[str, str] = Field(description="Names of the two bodies; the second may be an obstacle; both may be the same.")
    pairs: list[tuple[Index, Index]] | None = Field(
        default=None, description="Vertex of the first and of the second body, pair by pair."
    )
    points: list[tuple[Index, list[Index], list[NotNegative]]] | None = Field(
        default=None,
        description="Vertex of the first body, one to three vertices of a triangle of the second, and the weights that the point has "
        "there, as in [7, [3, 4], [0.25, 0.75]].",
    )
    within: Positive | None = Field(
        default=None,
        description="Sew each vertex of `select` to the nearest point `onto` the second body that is no further than this, m.",
    )
    select: Selection | None = Field(
        default=None, description="Which vertices of the first body `within` sews; absent: those on its rim."
    )
    onto: Literal["rim", "surface"] = Field(
        default="rim", description="What `within` sews to: open edges of the second body, or any point of it."
    )
    stiffness: Positive | None = Field(
        default=None, description="Of each thread, N/m; absent: the larger membrane stiffness of the two bodies."
    )
    length: NotNegative | None = Field(
        default=None,
        description="Length of the threads in the end, m; absent: the gap at which contact lets go, minimum separation and activation "
        "distance together. Below that, threads press the edges against each other's barrier.",
    )
    start: NotNegative = Field(default=0.0, description="When sewing begins, s; before, threads are loose.")
    duration: NotNegative = Field(default=0.0, description="How long it takes, s; 0: threads have their length at once.")

    @model_validator(mode="after")
    def _check(self) -> "Stitch":
        _exactly_one(self, "pairs", "points", "within")
        if self.within is None and (self.select is not None or self.onto != "rim"):
            raise ValueError("select and onto have no effect without within")
        return self


# --- bodies and obstacles ---


class Copies(Table):
    """A body repeated in a grid; the copies are called `name[0]`, `name[1]`, ... with x running fastest, then y, then z."""

    counts: tuple[Count, Count, Count] = Field(default=(1, 1, 1), description="Copies along x, y, z.")
    spacing: Vector = Field(default=(1.0, 1.0, 1.0), description="From one copy to the next along x, y, z, m.")


class Body(Placed):
    """What solids, cloth, rods and rigid bodies share."""

    velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="At the start, m/s.")
    angular_velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="At the start, about the centre of mass, rad/s.")
    pins: list[Pin] = Field(default=[], description="Vertices that are held.")
    copies: Copies | None = Field(default=None, description="Repeats the body in a grid.")


class Solid(Body):
    """A soft body of tetrahedra."""

    kind: Literal["solid"] = "solid"
    material: SolidMaterial = Field(default_factory=SolidMaterial, description="What it is made of.")
    tetrahedralize: StrictBool = Field(
        default=False, description='Fill a closed triangle mesh with tets on loading; needs the extra "tetrahedralize".'
    )


class Pattern(Table):
    """The flat panels that a cloth is cut from: each triangle of the cloth's mesh is at rest in the shape of its triangle here.

    Panels may lie anywhere in the pattern, and may overlap: only the shapes of triangles count. Masses are those of the pattern.
    """

    mesh: MeshSource | None = Field(
        default=None,
        description="A mesh of as many triangles as the cloth's, in the same order and each with its corners in the same order.",
    )
    uv: StrictBool = Field(
        default=False, description="In place of a mesh: the texture coordinates of the cloth's own .obj file."
    )
    scale: Positive = Field(default=1.0, description="Metres in a unit of the pattern.")

    @model_validator(mode="after")
    def _check(self) -> "Pattern":
        _exactly_one(self, "mesh", "uv")
        return self


class Cloth(Body):
    """A thin sheet of triangles."""

    kind: Literal["cloth"] = "cloth"
    material: ClothMaterial = Field(default_factory=ClothMaterial, description="What it is made of.")
    rest: Pattern | None = Field(
        default=None,
        description="Flat panels that it is cut from; absent: its mesh is its rest shape. The mesh is then where it starts.",
    )
    weld: Positive | None = Field(
        default=None,
        description="Vertices on open edges that start no further apart than this become one, m: closes seams of panels that coincide.",
    )
    open_seams: Positive | None = Field(
        default=None,
        description="Open edges of its parts are drawn back until they are this far apart, m, for stitches to close. The rest shape stays.",
    )
    inside: Inside | None = Field(
        default=None, description="What each closed part of it holds: a pressure, a gas or a liquid; needs the Newton solver."
    )


class Rod(Body):
    """A rope, cable, hair or ring: lines that stretch, bend and twist, as thick as their radius."""

    kind: Literal["rod"] = "rod"
    material: RodMaterial = Field(default_factory=RodMaterial, description="What it is made of.")
    minimum_separation: Positive | None = Field(
        default=None,
        description="Gap kept between the center lines of copies of this body, m; two bodies keep the mean. Absent: twice the radius.",
    )


class RigidMaterial(Table):
    """What keeps its shape."""

    density: Positive = Field(default=1000.0, le=1e5, description="Mass per volume, kg/m^3.")
    shape_stiffness: Positive = Field(
        default=1e9,
        le=1e13,
        description="Young's modulus, Pa, of what keeps the shape: a pressure p over the body strains it by about p over this.",
    )


class Rigid(Body):
    """A body that keeps its shape, whatever its mesh: twelve unknowns. Its surface must be closed; a mesh of tets gives its own.

    It has an inside of uniform density. Pins need a stiffness: what is to be held exactly is an obstacle.
    """

    kind: Literal["rigid"] = "rigid"
    material: RigidMaterial = Field(default_factory=RigidMaterial, description="What it is made of.")


def _cache_kind(value: Any) -> str | None:
    if isinstance(value, str | Path):
        return "file"
    return "framearrays" if isinstance(value, dict | FrameArrays) else None


def _motion_kind(value: Any) -> str:
    return "deformation" if isinstance(value, Deformation) or (isinstance(value, dict) and "cache" in value) else "motion"


class FrameArrays(Table):
    """Positions of all vertices of an obstacle over time, given by their numbers."""

    vertices: Annotated[np.ndarray, BeforeValidator(_frames), _AS_LIST, _FRAMES_SCHEMA] = Field(
        description="V (f, n, 3): of each frame, m."
    )
    times: list[Number] = Field(description="When each frame is there, s, ascending; counted from the first.")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FrameArrays) and self.times == other.times and np.array_equal(self.vertices, other.vertices)


class Deformation(Table):
    """All vertices of an obstacle over time: a cache, as animation programs write it. In between vertices go straight.

    It stands and is scaled as the mesh is. Before its first frame and after its last it holds still.
    """

    cache: Annotated[
        Annotated[_File, Tag("file")] | Annotated[FrameArrays, Tag("framearrays")],
        Discriminator(
            _cache_kind,
            custom_error_type="cache",
            custom_error_message="must be a file, a pattern of files, or a table with vertices and times",
        ),
    ] = Field(
        description="A file with V (frames, n, 3) and times (.npz) or time samples (USD, Alembic), a pattern of files that are a frame each, "
        "such as `body_*.obj`, or arrays; of as many vertices as the mesh has."
    )
    frame_rate: Positive | None = Field(
        default=None, le=1e6, description="Frames a second; absent: at the times that the cache says."
    )
    start: NotNegative = Field(default=0.0, description="When its first frame is there, s.")


class Obstacle(Placed):
    """A surface, open or closed, that moves or deforms as told and feels nothing."""

    motion: (
        Annotated[
            Annotated[Motion, Tag("motion")] | Annotated[Deformation, Tag("deformation")],
            Discriminator(_motion_kind),
        ]
        | None
    ) = Field(default=None, description="How it moves: rigidly, or with a cache of all its vertices; absent: not at all.")
    inward: bool = Field(
        default=False,
        description="Turns its triangles to face the other way: a closed surface that is solid then holds what is inside.",
    )


# --- forces ---


class _Window(Table):
    start: NotNegative = Field(default=0.0, description="When it begins, s.")
    end: Positive | None = Field(default=None, description="When it ends, s; absent: never.")

    @model_validator(mode="after")
    def _check_window(self) -> "_Window":
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end = {self.end} s must be later than start = {self.start} s")
        return self


class Wind(_Window):
    """Pressure of moving air: air_density / 2 drag area |u.n| (u.n) n on a triangle of normal n, past which it goes at u.

    No step drives a surface past the air: where the wind across it is faster than areal_density / (air_density drag time_step), with
    the default cloth and step 17 m/s, drag gives way within the step. Take smaller steps for cloth that is held in stronger wind.
    """

    kind: Literal["wind"] = "wind"
    velocity: Vector = Field(description="Velocity of the air, m/s.")
    air_density: Positive = Field(default=1.2, description="kg/m^3.")
    drag: NotNegative = Field(default=1.0, description="Drag coefficient.")
    bodies: Annotated[list[str], Field(min_length=1)] | None = Field(
        default=None, description="Names of the bodies that feel it; absent: all."
    )


class VertexForce(_Window):
    """A force on chosen vertices of a body, shared evenly among them."""

    kind: Literal["vertices"] = "vertices"
    body: str = Field(description="Name of the body.")
    select: Selection = Field(description="Which vertices.")
    force: Vector = Field(description="Total over the chosen vertices, N.")


# --- the scene ---


def _some_worlds(worlds: Any) -> Any:
    if isinstance(worlds, int) and not isinstance(worlds, bool):
        count = worlds
    elif isinstance(worlds, list | tuple) and all(isinstance(changes, dict) for changes in worlds):
        worlds = [flat(changes) for changes in worlds]
        count = len(worlds)
        for key in {str(key) for changes in worlds for key in changes}:
            split_key(key)
    else:
        raise ValueError("must be a number of copies, or a list of tables with what is other in each world")
    if not 1 <= count <= MOST_WORLDS:
        raise ValueError(f"must be 1 to {MOST_WORLDS} worlds")
    return worlds


class Scene(Table):
    """Everything that a simulation starts from."""

    title: str = Field(default="", description="One line.")
    description: str = Field(default="", description="What it shows.")
    simulation: Simulation = Field(default_factory=Simulation, description="How time advances.")
    contact: Contact = Field(default_factory=Contact, description="How surfaces keep apart.")
    bodies: list[Annotated[Solid | Cloth | Rod | Rigid, Field(discriminator="kind")]] = Field(
        min_length=1, description="What is simulated."
    )
    obstacles: list[Obstacle] = Field(default=[], description="Rigid surfaces, static or scripted.")
    attachments: list[Attachment] = Field(default=[], description="Springs between bodies.")
    stitches: list[Stitch] = Field(default=[], description="Threads that sew cloth.")
    forces: list[Annotated[Wind | VertexForce, Field(discriminator="kind")]] = Field(default=[], description="Beyond gravity.")
    picture: Picture = Field(default_factory=Picture, description="How runs are drawn.")
    worlds: Annotated[int | list[dict[str, Any]], BeforeValidator(_some_worlds)] | None = Field(
        default=None,
        description="Several simulations side by side that do not see each other: a number of copies, or a table for each with what is other "
        "in it, by dotted keys, such as `bodies.ball.velocity = [1, 0, 0]`; absent: one.",
    )

    @model_validator(mode="after")
    def _check(self) -> "Scene":
        names = [placed.name for placed in (*self.bodies, *self.obstacles)]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(f"names must be unique; used more than once: {', '.join(twice)}")
        return self

    def _repr_html_(self) -> str:
        """The start, for notebooks."""
        return importlib.import_module("pdipc.viewer.inline").html_of_scene(self)  # by name: see there

    def show(self, device: str | None = None, height: int = 500) -> Any:
        """Simulates it live in a frame of a notebook, `height` pixels high; `close()` of what is returned ends it. Needs the extra
        "viewer". Raises SceneError where it cannot be simulated.
        """
        return importlib.import_module("pdipc.viewer.inline").show_scene(self, device, height)

    def save(self, path: str | Path) -> None:
        """Writes TOML that `load_scene` reads as the same scene; what is the default is left out. Raises OSError where it cannot be
        written, ValueError for a name that does not end in .toml.
        """
        from pdipc.scene.save import to_toml

        path = Path(path)
        if path.suffix != ".toml":
            raise ValueError(f'"{path}": a scene is saved as TOML; the name must end in .toml')
        path.write_text(to_toml(self, path.parent.resolve()), encoding="utf-8")
