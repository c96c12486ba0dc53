"""Pictures and animations of a run, drawn off-screen with PyVista."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pdipc.output.results import Run, RunError

STILL = (".png", ".jpg")
MOVING = (".gif", ".mp4")
LARGEST = 8192  # pixels of a side: what every driver draws
PALETTE = ("#3f87c5", "#f0803c", "#4fae7b", "#e2b33c", "#9a72c0", "#dc5f7c", "#3fb0b5", "#a9825a")
OBSTACLE = "#c4c9d0"
OPACITY = 0.3  # of obstacles above the bodies, which would hide them
FLOOR = "#dde1e6"
BACKGROUND = "#f8f9fb"
SHARP_EDGE = 40.0  # degrees: sharper edges are not shaded smoothly
LARGE = 2.5  # an obstacle of more than so many times the size of what moves is not framed
REACH = 5.0  # a floor is drawn up to so many radii of what moves
OCCLUDERS = 4000  # triangles, whole or quartered, that are taken to shade a floor
VIEW = (0.7, 0.42, 1.0)  # from the middle of the bodies towards the camera
FIELD = "field"
COLORS = "viridis"  # of a field on the bodies
ANGLE = 28.0  # degrees: vertical field of view
FASTEST = 50.0  # frames a second that players show


def render(
    run: Run,
    frame: int,
    path: str | Path,
    size: tuple[int, int] = (1280, 800),
    view: tuple[float, float, float] = VIEW,
    field: "Field | None" = None,
) -> None:
    """Draws one frame into `path`, .png or .jpg. size: pixels. view: direction from what is seen to the camera; y is up.

    field: what colours the bodies, in place of a colour each.
    """
    picture = Picture(run, [frame], size, view, field)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    try:
        picture.plotter.screenshot(str(path))
    finally:
        picture.plotter.close()


def render_animation(
    run: Run,
    path: str | Path,
    every: int = 1,
    size: tuple[int, int] = (1280, 800),
    view: tuple[float, float, float] = VIEW,
    field: "Field | None" = None,
) -> None:
    """Draws every so many frames into `path`, .gif or .mp4; it plays as fast as what happened, with at most 50 frames a second.

    Raises RunError where there are no frames.
    """
    if run.frame_count == 0:
        raise RunError(f"{run.folder} has no frames")
    path = Path(path)
    frames = list(range(0, run.frame_count, every))
    rate = (len(frames) - 1) / float(run.times[frames[-1]]) if len(frames) > 1 else 1.0
    skip = max(1, round(rate / FASTEST))
    frames, rate = frames[::skip], rate / skip
    picture = Picture(run, frames, size, view, field)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        if path.suffix.lower() == ".gif":
            picture.plotter.open_gif(str(path), fps=rate, subrectangles=True)
        else:
            picture.plotter.open_movie(str(path), framerate=rate, quality=7, macro_block_size=2)
        for frame in frames:
            picture.show(frame)
            picture.plotter.write_frame()
    finally:
        picture.plotter.close()


@dataclass
class Field:
    """A number at each vertex, shown as colours. values(frame): (n,); top: what the last colour stands for."""

    title: str
    values: Callable[[int], np.ndarray]
    top: float


class Picture:
    """The bodies of a run, framed so that they stay in sight in all of `frames`; shows the first."""

    def __init__(
        self,
        run: Run,
        frames: list[int],
        size: tuple[int, int],
        view: tuple[float, float, float],
        field: Field | None = None,
    ):
        import pyvista

        self.run, self.field = run, field
        self.plotter = pyvista.Plotter(off_screen=True, window_size=list(size), lighting="none")
        self.plotter.set_background(BACKGROUND)
        seen = self._framed(frames)
        low, high = seen.min(axis=0), seen.max(axis=0)
        self.center, self.radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) or 1.0
        self.bodies: list[_Body | _Floor] = []
        start = run.positions(frames[0])
        for body, kind in enumerate(run.body_kinds):
            vertices, triangles = run.body_mesh(body)
            if not len(triangles):
                continue
            if kind == "obstacle" and _Floor.suits(start[vertices], self.center, self.radius):
                self.bodies.append(_Floor(self, start, vertices, body))
            else:
                color = OBSTACLE if kind == "obstacle" else PALETTE[body % len(PALETTE)]
                covers = kind == "obstacle" and start[vertices, 1].min() > self.center[1]
                self.bodies.append(_Body(self, start, vertices, triangles, kind, color, OPACITY if covers else 1.0))
        self._light()
        self._look(seen, np.array(view, dtype=float), size[0] / size[1])
        self.plotter.enable_anti_aliasing("ssaa")
        self.plotter.enable_ssao(radius=0.12 * self.radius, bias=0.004 * self.radius, kernel_size=96, blur=True)
        self.show(frames[0])

    def show(self, frame: int) -> None:
        """Moves the bodies to where they are in `frame`."""
        positions = self.run.positions(frame)
        values = self.field.values(frame) if self.field else None
        for body in self.bodies:
            body.move(positions)
            if values is not None and isinstance(body, _Body) and body.colored:
                body.mesh[FIELD] = values[body.vertices]

    def _framed(self, frames: list[int]) -> np.ndarray:
        """(k, 3): points of the bodies, and of the obstacles that are not much larger, over at most 30 of the frames."""
        kinds, of_vertex = self.run.body_kinds, self.run.topology["body_of_vertex"]
        sampled = [self.run.positions(frames[i]) for i in np.unique(np.linspace(0, len(frames) - 1, 30).astype(int))]
        points = [np.concatenate([positions[of_vertex == body] for positions in sampled]) for body in range(len(kinds))]
        moving = [own for own, kind in zip(points, kinds, strict=True) if kind != "obstacle"] or points
        size = LARGE * np.linalg.norm(np.ptp(np.concatenate(moving), axis=0))
        return np.concatenate(moving + [own for own in points if np.linalg.norm(np.ptp(own, axis=0)) < size])

    def _look(self, seen: np.ndarray, view: np.ndarray, aspect: float) -> None:
        """The camera as near as all points seen (k, 3) allow."""
        view /= np.linalg.norm(view)
        right = np.cross([0.0, 1.0, 0.0], view)
        right = right / np.linalg.norm(right) if right.any() else np.array([1.0, 0.0, 0.0])
        up = np.cross(view, right)
        away = seen - self.center
        slope = np.tan(np.radians(ANGLE / 2)) * 0.9
        needed = np.maximum(np.abs(away @ up) / slope, np.abs(away @ right) / (slope * aspect)) + away @ view
        camera = self.plotter.camera
        camera.focal_point = self.center
        camera.position = self.center + needed.max() * view
        camera.up = up
        camera.view_angle = ANGLE

    def _light(self) -> None:
        import pyvista

        lights = (((-0.5, 1.0, 0.8), 0.85), ((1.0, 0.5, 0.25), 0.5), ((0.1, 0.3, -1.0), 0.25), ((0.0, -1.0, 0.3), 0.15))
        for direction, strength in lights:
            place = self.center + 50.0 * self.radius * np.array(direction)
            light = pyvista.Light(position=place, focal_point=self.center, intensity=strength, light_type="scene light")
            self.plotter.add_light(light)


class _Body:
    """The mesh of one body; its points are `vertices` of the run, doubled along sharp edges."""

    def __init__(
        self,
        picture: Picture,
        positions: np.ndarray,
        vertices: np.ndarray,
        triangles: np.ndarray,
        kind: str,
        color: str,
        opacity: float,
    ):
        import pyvista

        self.mesh = pyvista.PolyData.from_regular_faces(positions[vertices], triangles)
        self.mesh["vertex"] = vertices
        if kind != "cloth":
            self.mesh = self.mesh.compute_normals(split_vertices=True, feature_angle=SHARP_EDGE, consistent_normals=False)
        self.vertices = np.asarray(self.mesh["vertex"])
        field = None if kind == "obstacle" else picture.field
        self.colored = field is not None
        look: dict = {"color": color}
        if field is not None:
            self.mesh[FIELD] = np.zeros(len(self.vertices))
            bar = {"title": field.title, "color": "black", "n_labels": 2, "fmt": "%.2g", "width": 0.5, "position_x": 0.25}
            look = {"scalars": FIELD, "clim": (0.0, field.top), "cmap": COLORS, "scalar_bar_args": bar}
        picture.plotter.add_mesh(
            self.mesh,
            **look,
            opacity=opacity,
            culling="back" if opacity < 1.0 else False,  # unsorted faces behind others would show in places
            smooth_shading=True,
            ambient=0.22,
            diffuse=0.85,
            specular=0.0 if kind == "obstacle" else 0.15,
            specular_power=25,
        )

    def move(self, positions: np.ndarray) -> None:
        self.mesh.points = positions[self.vertices]
        self.mesh.compute_normals(
            cell_normals=False, inplace=True, split_vertices=False, consistent_normals=False, auto_orient_normals=False
        )


class _Floor:
    """A large plane, drawn as a disc that fades into the background, with the soft shade of what is near it.

    The shade is the part of the half-space above that the bodies cover: form factors of their triangles.
    """

    def __init__(self, picture: Picture, positions: np.ndarray, vertices: np.ndarray, body: int):
        import pyvista

        self.picture, self.vertices = picture, vertices
        disc = pyvista.Disc(inner=0.0, outer=1.0, r_res=56, c_res=96).triangulate()
        spread = np.asarray(disc.points) / np.maximum(np.linalg.norm(disc.points, axis=1, keepdims=True), 1e-9)
        self.flat = (spread * np.linalg.norm(disc.points, axis=1, keepdims=True) ** 1.6)[:, :2]  # denser near the middle
        self.colors = [np.array(pyvista.Color(color).float_rgb) for color in (FLOOR, BACKGROUND)]
        occluding = np.flatnonzero(picture.run.body_of_triangle != body)
        self.occluders = picture.run.triangles[occluding[:: 1 + len(occluding) // OCCLUDERS]]
        self.two_sided = (
            np.array(picture.run.body_kinds)[picture.run.topology["body_of_vertex"][self.occluders[:, 0]]] == "cloth"
        )
        self.share = len(occluding) / max(1, len(self.occluders))
        self.mesh = disc
        self.move(positions)
        picture.plotter.add_mesh(self.mesh, scalars="color", rgb=True, lighting=False)

    @staticmethod
    def suits(points: np.ndarray, center: np.ndarray, radius: float) -> bool:
        """Whether the points (k, 3) span a flat rectangle that reaches well around what moves."""
        _, extents, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
        along = (points - center) @ axes.T
        reach = np.minimum(along.max(axis=0), -along.min(axis=0))[:2].min()
        return len(points) >= 4 and bool(extents[2] < 1e-6 * extents[0]) and reach > 0.9 * radius

    def move(self, positions: np.ndarray) -> None:
        points, center = positions[self.vertices], self.picture.center
        axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
        along = (points - center) @ axes.T
        reach = min(np.minimum(along.max(axis=0), -along.min(axis=0))[:2].min(), REACH * self.picture.radius)
        height = float(along[:, 2].mean())
        self.mesh.points = center + reach * self.flat @ axes[:2] + height * axes[2]
        shade = self._shade(positions, axes[2] * -np.sign(height or 1.0))[:, None]
        faded = np.clip((np.linalg.norm(self.flat, axis=1, keepdims=True) - 0.35) / 0.6, 0.0, 1.0)
        faded = faded * faded * (3.0 - 2.0 * faded)
        near, far = self.colors
        color = (1.0 - faded) * near * (1.0 - 0.6 * (1.0 - np.exp(-1.5 * shade))) + faded * far
        self.mesh["color"] = (255.0 * color + 0.5).astype(np.uint8)

    def _shade(self, positions: np.ndarray, up: np.ndarray) -> np.ndarray:
        corners, two_sided = positions[self.occluders].astype(np.float32), self.two_sided
        while 0 < 4 * len(corners) <= OCCLUDERS:
            ends = 0.5 * (corners + np.roll(corners, -1, axis=1))  # middles of the edges 01, 12, 20
            thirds = [np.stack([corners[:, k], ends[:, k], ends[:, k - 1]], axis=1) for k in range(3)]
            corners, two_sided = np.concatenate([*thirds, ends]), np.tile(two_sided, 4)
        area_normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        middle, area = corners.mean(axis=1), np.linalg.norm(area_normals, axis=1)
        shade = np.zeros(len(self.mesh.points), dtype=np.float32)
        for i, point in enumerate(np.asarray(self.mesh.points, dtype=np.float32)):
            to = middle - point
            square = np.einsum("ij,ij->i", to, to)
            facing = -np.einsum("ij,ij->i", to, area_normals)
            facing = np.where(two_sided, np.abs(facing), np.maximum(facing, 0.0))
            facing += 0.4 * area**1.5 * np.exp(-square / (area + 1e-20))  # nearer than its size, a triangle is no point
            shade[i] = np.sum(np.maximum(to @ up, 0.0) * facing / (square * (np.pi * square + area) + 1e-20))
        return np.minimum(self.share * shade, 2.0)
