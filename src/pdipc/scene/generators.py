"""Shapes that a scene can name instead of a mesh file.

Every closed shape is one lattice of cells, mapped to its place: a solid takes the tets, cloth and obstacles their surface.
Each cell is cut into six tets around the diagonal that points away from the shape's middle. So shapes are symmetric, tets
of neighbouring cells match, and no tet lies flat where a rounded shape takes up an edge of the lattice.
"""

import itertools
import math
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from pdipc.scene import figures
from pdipc.scene.meshes import Mesh
from pdipc.scene.tables import Real, Table, Whole

Length = Annotated[Real, Field(gt=0, le=1e6, allow_inf_nan=False)]
Count = Annotated[Whole, Field(ge=1, le=4096)]
Across = Annotated[Whole, Field(ge=2, le=1024)]
Vector = tuple[Length, Length, Length]


class Shape(Table):
    """What all shapes share."""

    def cell_count(self) -> int:
        """Number of the cells that `mesh` cuts."""
        raise NotImplementedError

    def bytes(self) -> int:
        """Memory that `mesh` needs, measured."""
        return self.cell_count() * (250 if isinstance(self, (Grid, Plane, *LINES)) else 2300)

    def mesh(self) -> Mesh:
        """The shape about its origin: tets with their surface, or triangles for the open shapes."""
        raise NotImplementedError


class Box(Shape):
    """A block, centred at the origin."""

    shape: Literal["box"] = "box"
    size: Vector = Field(default=(1.0, 1.0, 1.0), description="Extent along x, y, z, m.")
    cells: tuple[Count, Count, Count] = Field(default=(4, 4, 4), description="Cells along x, y, z; each is cut into six tets.")

    def cell_count(self) -> int:
        return math.prod(self.cells)

    def mesh(self) -> Mesh:
        points, tets = lattice(self.cells)
        return Mesh.of_tets(0.5 * points * self.size, tets)


class Sphere(Shape):
    """A ball, centred at the origin."""

    shape: Literal["sphere"] = "sphere"
    radius: Length = Field(default=0.5, description="Radius, m.")
    cells: Across = Field(default=8, description="Cells across the diameter.")

    def cell_count(self) -> int:
        return self.cells**3

    def mesh(self) -> Mesh:
        points, tets = lattice((self.cells, self.cells, self.cells))
        return Mesh.of_tets(self.radius * rounded(points), tets)


class Cylinder(Shape):
    """A cylinder or rod along y, centred at the origin."""

    shape: Literal["cylinder"] = "cylinder"
    radius: Length = Field(default=0.5, description="Radius, m.")
    length: Length = Field(default=1.0, description="Extent along y, m.")
    cells: tuple[Across, Count] = Field(default=(6, 6), description="Cells across the diameter and along y.")

    def cell_count(self) -> int:
        return self.cells[0] ** 2 * self.cells[1]

    def mesh(self) -> Mesh:
        points, tets = lattice((self.cells[0], self.cells[1], self.cells[0]))
        disc = self.radius * rounded(points[:, [0, 2]])
        return Mesh.of_tets(np.column_stack([disc[:, 0], 0.5 * self.length * points[:, 1], disc[:, 1]]), tets)


class Capsule(Shape):
    """A cylinder along y between two half balls, centred at the origin."""

    shape: Literal["capsule"] = "capsule"
    radius: Length = Field(default=0.25, description="Radius, m.")
    length: Length = Field(default=0.5, description="Extent of the cylinder along y, without the half balls, m.")
    cells: tuple[Annotated[Whole, Field(ge=2, le=1024, multiple_of=2)], Count] = Field(
        default=(6, 4), description="Cells across the diameter (even), and along the cylinder."
    )

    def cell_count(self) -> int:
        return self.cells[0] ** 2 * sum(self.cells)

    def mesh(self) -> Mesh:
        across, along = self.cells
        points, tets = lattice((across, across + along, across))
        layer = np.rint(0.5 * (points[:, 1] + 1) * (across + along))  # 0 .. across + along
        middle = np.clip(layer - across // 2, 0, along)  # 0 .. along while in the cylinder
        points[:, 1] = 2 * (layer - middle) / across - 1
        points = self.radius * rounded(points)
        points[:, 1] += self.length * (middle / along - 0.5)
        return Mesh.of_tets(points, tets)


class Torus(Shape):
    """A ring around y, centred at the origin."""

    shape: Literal["torus"] = "torus"
    major_radius: Length = Field(default=0.5, description="Radius of the ring's centre line, m; larger than minor_radius.")
    minor_radius: Length = Field(default=0.2, description="Radius of its section, m.")
    cells: tuple[Across, Annotated[Whole, Field(ge=3, le=4096)]] = Field(
        default=(4, 24), description="Cells across and around."
    )

    def model_post_init(self, _) -> None:
        if self.minor_radius >= self.major_radius:
            raise ValueError(f"minor_radius {self.minor_radius} must be smaller than major_radius {self.major_radius}")

    def cell_count(self) -> int:
        return self.cells[0] ** 2 * self.cells[1]

    def mesh(self) -> Mesh:
        points, tets = lattice((self.cells[0], self.cells[0], self.cells[1]), ring=True)
        section = self.minor_radius * rounded(points[:, :2])
        angle = np.pi * points[:, 2]
        reach = self.major_radius + section[:, 0]
        return Mesh.of_tets(np.column_stack([reach * np.cos(angle), section[:, 1], reach * np.sin(angle)]), tets)


class Bowl(Shape):
    """A shell of a sphere, open at the top; the origin is the sphere's centre."""

    shape: Literal["bowl"] = "bowl"
    radius: Length = Field(default=1.0, description="Inner radius, m.")
    thickness: Length = Field(default=0.05, description="Thickness of the shell, outward, m.")
    opening: Real = Field(default=80.0, gt=0, le=150, description="Angle between the downward axis and the rim, degrees.")
    cells: tuple[Across, Count] = Field(default=(16, 1), description="Cells across the bowl, and through its thickness.")

    def cell_count(self) -> int:
        return self.cells[0] ** 2 * self.cells[1]

    def mesh(self) -> Mesh:
        points, tets = lattice((self.cells[0], self.cells[1], self.cells[0]))
        disc = rounded(points[:, [0, 2]])
        far = np.linalg.norm(disc, axis=1)
        angle = far * np.radians(self.opening)
        radius = self.radius + self.thickness * 0.5 * (1 - points[:, 1])
        sideways = np.where(far > 0, np.sin(angle) / np.where(far > 0, far, 1), 0.0)[:, None] * disc
        return Mesh.of_tets(radius[:, None] * np.column_stack([sideways[:, 0], -np.cos(angle), sideways[:, 1]]), tets)


class Stairs(Shape):
    """Solid steps that go down along +x; the origin is the middle of the lowest edge at the foot of the highest step."""

    shape: Literal["stairs"] = "stairs"
    steps: Annotated[Whole, Field(ge=1, le=100)] = Field(default=5, description="Number of steps.")
    rise: Length = Field(default=0.2, description="Height of a step, m.")
    run: Length = Field(default=0.3, description="Depth of a step along x, m.")
    width: Length = Field(default=2.0, description="Extent along z, m.")

    def cell_count(self) -> int:
        return self.steps**2

    def mesh(self) -> Mesh:
        n = self.steps
        points, tets = lattice((n, n, 1))
        cell = np.arange(n * n).repeat(6)
        column, row = cell // n, cell % n
        points = np.column_stack(
            [
                0.5 * (points[:, :1] + 1) * n * self.run,
                0.5 * (points[:, 1:2] + 1) * n * self.rise,
                0.5 * points[:, 2:] * self.width,
            ]
        )
        return Mesh.of_tets(points, tets[column + row < n])


class Grid(Shape):
    """A flat rectangle of triangles in the plane of x and z, facing +y, centred at the origin."""

    shape: Literal["grid"] = "grid"
    size: tuple[Length, Length] = Field(default=(1.0, 1.0), description="Extent along x and z, m.")
    cells: tuple[Count, Count] = Field(default=(20, 20), description="Cells along x and z; each is cut into two triangles.")
    diagonals: Literal["alternating", "parallel"] = Field(
        default="alternating", description='How cells are cut: "alternating" favours no direction, "parallel" cuts all alike.'
    )

    def cell_count(self) -> int:
        return math.prod(self.cells)

    def mesh(self) -> Mesh:
        nx, nz = self.cells
        x, z = np.meshgrid(np.linspace(-0.5, 0.5, nx + 1), np.linspace(-0.5, 0.5, nz + 1), indexing="ij")
        vertices = np.column_stack([x.ravel() * self.size[0], np.zeros(x.size), z.ravel() * self.size[1]])
        i, j = (index.ravel() for index in np.meshgrid(np.arange(nx), np.arange(nz), indexing="ij"))
        a = i * (nz + 1) + j  # corners a (low x, low z), b (+x), c (+x +z), d (+z)
        b, c, d = a + nz + 1, a + nz + 2, a + 1
        turned = ((i + j) % 2 == 1) & (self.diagonals == "alternating")
        first = np.where(turned, [a, d, b], [a, c, b]).T
        second = np.where(turned, [b, d, c], [a, d, c]).T
        return Mesh(vertices, np.stack([first, second], axis=1).reshape(-1, 3).astype(np.int32))


class Plane(Shape):
    """A square floor of two triangles in the plane of x and z, facing +y, centred at the origin."""

    shape: Literal["plane"] = "plane"
    size: Length = Field(default=10.0, description="Length of a side, m.")

    def cell_count(self) -> int:
        return 1

    def mesh(self) -> Mesh:
        return Grid(size=(self.size, self.size), cells=(1, 1)).mesh()


class Rope(Shape):
    """A straight line along x, centred at the origin, for rods."""

    shape: Literal["rope"] = "rope"
    length: Length = Field(default=1.0, description="Extent along x, m.")
    segments: Count = Field(default=40, description="Number of segments.")

    def cell_count(self) -> int:
        return self.segments

    def mesh(self) -> Mesh:
        x = np.linspace(-0.5, 0.5, self.segments + 1) * self.length
        ends = np.arange(self.segments)
        return Mesh.of_lines(np.column_stack([x, 0 * x, 0 * x]), np.column_stack([ends, ends + 1]))


class Ring(Shape):
    """A closed circle in the plane of x and y, centred at the origin, for rods."""

    shape: Literal["ring"] = "ring"
    radius: Length = Field(default=0.1, description="Radius of the circle, m.")
    segments: Annotated[Whole, Field(ge=3, le=4096)] = Field(default=24, description="Number of segments.")

    def cell_count(self) -> int:
        return self.segments

    def mesh(self) -> Mesh:
        angle = 2.0 * np.pi * np.arange(self.segments) / self.segments
        points = self.radius * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
        ends = np.arange(self.segments)
        return Mesh.of_lines(points, np.column_stack([ends, (ends + 1) % self.segments]))


class Coil(Shape):
    """A helix about y, centred at the origin, for rods."""

    shape: Literal["coil"] = "coil"
    radius: Length = Field(default=0.1, description="Radius of the helix, m.")
    height: Length = Field(default=0.2, description="Extent along y, m.")
    turns: Annotated[Real, Field(gt=0, le=1000, allow_inf_nan=False)] = Field(
        default=5.0, description="How often it goes around."
    )
    segments: Count = Field(default=120, description="Number of segments.")

    def cell_count(self) -> int:
        return self.segments

    def mesh(self) -> Mesh:
        part = np.linspace(0.0, 1.0, self.segments + 1)
        angle = 2.0 * np.pi * self.turns * part
        points = [self.radius * np.cos(angle), self.height * (part - 0.5), self.radius * np.sin(angle)]
        ends = np.arange(self.segments)
        return Mesh.of_lines(np.column_stack(points), np.column_stack([ends, ends + 1]))


class Knot(Shape):
    """A rope along x with a loose overhand knot in its middle, for rods: Shastri's curve, which no pull at its ends undoes."""

    shape: Literal["knot"] = "knot"
    length: Length = Field(default=1.0, description="Length of the rope, m.")
    segments: Annotated[Whole, Field(ge=20, le=4096)] = Field(default=120, description="Number of segments.")

    def cell_count(self) -> int:
        return self.segments

    def mesh(self) -> Mesh:
        t = np.linspace(-2.2, 2.2, 4001)
        curve = np.column_stack([t**3 - 3 * t, t**4 - 4 * t**2, 0.4 * (t**5 - 10 * t)])
        curve[:, 1] -= curve[0, 1]
        # straight on from both ends, along x, for as long as the knot itself
        run = np.abs(curve[-1, 0] - curve[0, 0])
        ends = [curve[0] - [run, 0, 0], curve[-1] + [run, 0, 0]]
        curve = np.concatenate([ends[:1], curve, ends[1:]])
        fine = _evenly(curve, 2000)
        window = np.hanning(121) / np.hanning(121).sum()  # rounds the two corners
        padded = np.pad(fine, ((60, 60), (0, 0)), mode="reflect", reflect_type="odd")
        points = _evenly(np.column_stack([np.convolve(padded[:, axis], window, "valid") for axis in range(3)]), self.segments)
        points *= self.length / np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
        ends = np.arange(self.segments)
        return Mesh.of_lines(points, np.column_stack([ends, ends + 1]))


LINES = (Rope, Ring, Coil, Knot)


def _evenly(curve: np.ndarray, segments: int) -> np.ndarray:
    """(segments + 1, 3): points at even distances along a curve (n, 3)."""
    passed = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(curve, axis=0), axis=1))])
    at = np.linspace(0.0, passed[-1], segments + 1)
    return np.column_stack([np.interp(at, passed, curve[:, axis]) for axis in range(3)])


class Skirt(Shape):
    """Layers of cloth around y, open above and below, that widen downward in waves; the origin is the middle of the waist.

    The innermost layer is the longest; each further one starts `gap` outside of it and is shorter by an equal part.
    """

    shape: Literal["skirt"] = "skirt"
    waist: Length = Field(default=0.1, description="Radius at the top of the innermost layer, m.")
    hem: Length = Field(default=0.25, description="Mean radius at its lower end, m; larger than waist.")
    length: Length = Field(default=0.3, description="Of the innermost layer, along y, m.")
    layers: Annotated[Whole, Field(ge=1, le=10)] = Field(default=3, description="Number of layers.")
    gap: Length = Field(default=0.01, description="Between layers at the waist, m; twice as much at the hem.")
    waves: Annotated[Whole, Field(ge=0, le=100)] = Field(
        default=8, description="Folds around; the cells around should be six times as many."
    )
    cells: tuple[Annotated[Whole, Field(ge=3, le=4096)], Count] = Field(
        default=(64, 16), description="Cells around, and down the innermost layer; each is cut into two triangles."
    )

    def model_post_init(self, _) -> None:
        if self.waist >= self.hem:
            raise ValueError(f"hem {self.hem} must be larger than waist {self.waist}")

    def cell_count(self) -> int:
        return self.layers * math.prod(self.cells)

    def bytes(self) -> int:
        return self.cell_count() * 250

    def mesh(self) -> Mesh:
        around, down = self.cells
        vertices, triangles = [], []
        for layer in range(self.layers):
            rows = max(1, round(down * (self.layers - layer) / self.layers))
            part, angle = np.meshgrid(np.arange(rows + 1) / down, 2 * np.pi * np.arange(around) / around, indexing="ij")
            part, angle = part.ravel(), angle.ravel()
            wave = 0.15 * np.cos(self.waves * angle) if self.waves else 0.0
            radius = self.waist + (self.hem - self.waist) * part * (1 + wave)
            radius += layer * self.gap * (1 + part)
            own = np.column_stack([radius * np.cos(angle), -self.length * part, radius * np.sin(angle)])
            i, j = (index.ravel() for index in np.indices((rows, around)))
            a, b = i * around + j, i * around + (j + 1) % around
            c, d = a + around, b + around
            turned = ((i + j) % 2 == 1)[:, None]
            first = np.where(turned, np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
            second = np.where(turned, np.stack([b, d, c], axis=1), np.stack([a, d, c], axis=1))
            triangles.append(sum(map(len, vertices)) + np.concatenate([first, second]))
            vertices.append(own)
        return Mesh(np.concatenate(vertices), np.concatenate(triangles).astype(np.int32))


class Figure(Shape):
    """An animal or a thing of round parts, its bounding box centred at the origin; y is up, and it faces +z."""

    shape: Literal["figure"] = "figure"
    name: Literal[tuple(figures.FIGURES)] = Field(description="Which.")  # type: ignore[valid-type]
    size: Length = Field(default=1.0, description="Largest extent, m.")
    cells: Annotated[Whole, Field(ge=6, le=400)] = Field(
        default=24, description="Cells of the lattice across the largest extent; parts thinner than a cell are lost."
    )

    def cell_count(self) -> int:
        return self.cells**3

    def bytes(self) -> int:
        return self.cells**3 * 1500

    def mesh(self) -> Mesh:
        return figures.mesh(self.name, self.size, self.cells)


SHAPES = (Box, Sphere, Cylinder, Capsule, Torus, Bowl, Stairs, Grid, Plane, *LINES, Skirt, Figure)


def lattice(cells: tuple[int, int, int], ring: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Points (n, 3) of [-1, 1]^3 and the (6 c, 4) tets of its c cells, six after six; cells run over z fastest.

    ring: the last layer of points along z is the first one.
    """
    counts = np.array(cells)
    nodes = counts + 1 - np.array([0, 0, ring])
    points = 2.0 * np.indices(tuple(nodes)).reshape(3, -1).T / counts - 1.0
    cell = np.indices(tuple(counts)).reshape(3, -1).T
    outward = 2 * cell + 1 > counts  # per axis: does the cell's diagonal run up?

    def node(corner: np.ndarray) -> np.ndarray:
        at = (cell + np.where(outward, corner, 1 - corner)) % np.where(ring, np.append(nodes[:2] + 1, nodes[2]), nodes + 1)
        return (at[:, 0] * nodes[1] + at[:, 1]) * nodes[2] + at[:, 2]

    tets = np.empty((len(cell), 6, 4), dtype=np.int64)
    axes = np.eye(3, dtype=np.int64)
    for path, (i, j, k) in enumerate(itertools.permutations(range(3))):
        corners = [node(np.zeros(3, dtype=np.int64)), node(axes[i]), node(axes[i] + axes[j]), node(np.ones(3, dtype=np.int64))]
        tets[:, path] = np.stack(corners, axis=1)
        even = (i, j, k) in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        mirrored = (np.count_nonzero(~outward, axis=1) % 2 == 1) == even
        tets[mirrored, path] = tets[mirrored, path][:, [0, 2, 1, 3]]
    return points, tets.reshape(-1, 4)


def rounded(points: np.ndarray) -> np.ndarray:
    """Maps [-1, 1]^d to the unit ball (or disc), equiangular on the surface and nearly unchanged near the middle."""
    shell = np.abs(points).max(axis=1, keepdims=True)  # the cube shell that a point lies on
    on_face = np.tan(0.25 * np.pi * points / np.where(shell > 0, shell, 1.0))
    length = np.linalg.norm(on_face, axis=1, keepdims=True)
    core = 0.75 * shell * on_face
    ball = shell * on_face / np.where(length > 0, length, 1.0)
    return (1.0 - shell) * core + shell * ball
