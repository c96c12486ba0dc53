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
        return self.cell_count() * (250 if isinstance(self, Grid | Plane) else 2300)

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


SHAPES = (Box, Sphere, Cylinder, Capsule, Torus, Bowl, Stairs, Grid, Plane)


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
