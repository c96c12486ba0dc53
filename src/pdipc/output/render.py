"""Pictures and animations of a run, drawn off-screen with PyVista."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pdipc.output.results import Run, RunError

if TYPE_CHECKING:
    import pyvista

STILL = (".png", ".jpg")
MOVING = (".gif", ".mp4")
PALETTE = ("#3f87c5", "#f0803c", "#4fae7b", "#e2b33c", "#9a72c0", "#dc5f7c", "#3fb0b5", "#a9825a")
OBSTACLE = "#d3d6db"
BACKGROUND = ("#dfe4ea", "#ffffff")  # bottom, top
SHARP_EDGE = 40.0  # degrees: sharper edges are not shaded smoothly
REACH = 9.0  # obstacles are drawn up to so many radii of what moves; a floor may be as large as it likes
VIEW = (0.7, 0.5, 1.0)  # from the middle of the bodies towards the camera
ANGLE = 28.0  # degrees: vertical field of view
FASTEST = 50.0  # frames a second that players show


def render(
    run: Run,
    frame: int,
    path: str | Path,
    size: tuple[int, int] = (1280, 800),
    view: tuple[float, float, float] = VIEW,
) -> None:
    """Draws one frame into `path`, .png or .jpg. size: pixels. view: direction from what is seen to the camera; y is up."""
    picture = Picture(run, [frame], size, view)
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
    picture = Picture(run, frames, size, view)
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


class Picture:
    """The bodies of a run, framed so that they stay in sight in all of `frames`; shows the first."""

    def __init__(self, run: Run, frames: list[int], size: tuple[int, int], view: tuple[float, float, float]):
        import pyvista

        self.run = run
        self.plotter = pyvista.Plotter(off_screen=True, window_size=list(size), lighting="none")
        self.plotter.set_background(BACKGROUND[0], top=BACKGROUND[1])
        self.bodies: list[_Body] = []
        start = run.positions(frames[0])
        low, high = self._bounds(frames)
        self.center, self.radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm(high - low)) or 1.0
        for body, kind in enumerate(run.body_kinds):
            vertices, triangles = run.body_mesh(body)
            if len(triangles):
                color = OBSTACLE if kind == "obstacle" else PALETTE[body % len(PALETTE)]
                self.bodies.append(_Body(self, start, vertices, triangles, kind, color))
        self._light()
        self._look(np.array([low, high]), np.array(view, dtype=float), size[0] / size[1])
        self.plotter.enable_anti_aliasing("ssaa")
        self.plotter.enable_ssao(radius=0.12 * self.radius, bias=0.004 * self.radius, kernel_size=96, blur=True)
        self.show(frames[0])

    def show(self, frame: int) -> None:
        """Moves the bodies to where they are in `frame`."""
        positions = self.run.positions(frame)
        for body in self.bodies:
            body.move(positions)

    def _bounds(self, frames: list[int]) -> tuple[np.ndarray, np.ndarray]:
        """Box around all that is no obstacle, over at most 30 of the frames; around everything where there is no such body."""
        kinds = np.array(self.run.body_kinds)
        shown = kinds[self.run.topology["body_of_vertex"]] != "obstacle"
        shown = shown if shown.any() else np.ones_like(shown)
        sampled = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 30).astype(int))]
        points = [self.run.positions(frame)[shown] for frame in sampled]
        return np.min([p.min(axis=0) for p in points], axis=0), np.max([p.max(axis=0) for p in points], axis=0)

    def _look(self, box: np.ndarray, view: np.ndarray, aspect: float) -> None:
        """The camera as near as all corners of the box allow."""
        view /= np.linalg.norm(view)
        right = np.cross([0.0, 1.0, 0.0], view)
        right = right / np.linalg.norm(right) if right.any() else np.array([1.0, 0.0, 0.0])
        up = np.cross(view, right)
        corners = np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(-1, 3) - self.center
        slope = np.tan(np.radians(ANGLE / 2)) * 0.9
        needed = np.maximum(np.abs(corners @ up) / slope, np.abs(corners @ right) / (slope * aspect)) + corners @ view
        camera = self.plotter.camera
        camera.focal_point = self.center
        camera.position = self.center + needed.max() * view
        camera.up = up
        camera.view_angle = ANGLE

    def _light(self) -> None:
        import pyvista

        for direction, strength in (
            ((-0.6, 1.0, 0.5), 0.62),
            ((1.0, 0.6, 0.4), 0.28),
            ((0.2, 0.3, -1.0), 0.2),
            ((0, 1, 0), 0.2),
        ):
            place = self.center + 50.0 * self.radius * np.array(direction)
            light = pyvista.Light(position=place, focal_point=self.center, intensity=strength, light_type="scene light")
            self.plotter.add_light(light)


class _Body:
    """The mesh of one body; its points are `vertices` of the run, doubled along sharp edges."""

    def __init__(
        self, picture: Picture, positions: np.ndarray, vertices: np.ndarray, triangles: np.ndarray, kind: str, color: str
    ):
        import pyvista

        mesh = pyvista.PolyData.from_regular_faces(positions[vertices], triangles)
        mesh["vertex"] = vertices
        if kind != "cloth":
            mesh = mesh.compute_normals(split_vertices=True, feature_angle=SHARP_EDGE, consistent_normals=False)
        self.vertices = np.asarray(mesh["vertex"])
        self.mesh, self.drawn = mesh, mesh
        self.center, self.reach = picture.center, REACH * picture.radius
        self.clipped = kind == "obstacle" and np.abs(mesh.points - self.center).max() > self.reach
        if self.clipped:
            self.drawn = mesh.copy()
        back = {"color": pyvista.Color(color).hex_rgb, "diffuse": 0.75, "ambient": 0.2} if kind == "cloth" else None
        picture.plotter.add_mesh(
            self.drawn,
            color=color,
            smooth_shading=True,
            scalars=None,
            ambient=0.16,
            diffuse=0.9,
            specular=0.0 if kind == "obstacle" else 0.18,
            specular_power=25,
            backface_params=back,
        )

    def move(self, positions: np.ndarray) -> None:
        self.mesh.points = positions[self.vertices]
        self.mesh.compute_normals(
            cell_normals=False, inplace=True, split_vertices=False, consistent_normals=False, auto_orient_normals=False
        )
        if self.clipped:
            cut = self.mesh
            for axis in np.vstack([np.eye(3), -np.eye(3)]):
                cut = cut.clip(normal=axis, origin=self.center + self.reach * axis)
            self.drawn.copy_from(cut)
